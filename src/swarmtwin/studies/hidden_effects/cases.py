"""The sessions of the study: which effect hides in which of them, how clearly, all drawn from one seed."""

import math
import zlib
from collections.abc import Mapping, Sequence
from typing import Annotated, Literal, get_args

import numpy as np
from pydantic import Field

from swarmtwin.errors import UserError, near_miss
from swarmtwin.robot import Positive, Seed, StrictModel
from swarmtwin.studies.hidden_effects.clean_sessions import VARIETIES
from swarmtwin.studies.hidden_effects.effect_sizes import CATALOGUE, Sizes
from swarmtwin.studies.hidden_effects.hideable_effects import SIZES, effect_class
from swarmtwin.studies.hidden_effects.other_laws import OTHER_LAWS
from swarmtwin.studies.stand_in_families import Family, driver_of, has_effect, has_robot

Kind = Literal["one", "two", "three", "misspecified", "outside", "clean"]
KINDS: tuple[Kind, ...] = get_args(Kind)
Count = Annotated[int, Field(ge=1)]
Rises = tuple[Positive, Positive]


class Case(StrictModel):
    """One session to diagnose: everything in it follows from these few words.

    Attributes:
        family: which physics play the robot.
        kind: how many causes of the catalogue hide in it, one that acts by another law than its mechanism, something
            that the catalogue does not know, or nothing.
        robot: its name.
        names: of the effects hidden.
        rises_percent: by how much each of them alone is to raise the one-step error, where its sizes reach that far.
        variety: what is unlike the reference in a session with nothing wrong; empty otherwise.
        seed: of everything random, the reference and its vehicle included.
        runs: of a usual session.
        steps: transitions in its runs.
        reference_runs: of the recording that the simulation is learned from.
        reference_vehicles: that drove these runs, one after the other, none of them another one that is measured.
    """

    family: Family
    kind: Kind
    robot: str
    names: tuple[str, ...] = ()
    rises_percent: tuple[Positive, ...] = ()
    variety: str = ""
    seed: Seed
    runs: Count = 100
    steps: Count = 40
    reference_runs: Count = 150
    reference_vehicles: Count = 1

    @property
    def key(self) -> str:
        """What tells it from all other cases."""
        return self.model_dump_json()

    @property
    def about(self) -> str:
        """What is hidden, or what kind of clean session it is, in a word."""
        return "+".join(self.names) or self.variety

    @property
    def true_names(self) -> tuple[str, ...]:
        """The causes that a diagnosis should name: none where the catalogue has no name."""
        if self.kind == "misspecified":
            return tuple(OTHER_LAWS[name].cause for name in self.names)
        return () if self.kind == "outside" else self.names

    def rng(self, purpose: str) -> np.random.Generator:
        """Return random numbers for one purpose, whatever else is drawn."""
        return np.random.default_rng([self.seed, zlib.crc32(purpose.encode())])


def cases(
    family: Family,
    kind: Kind,
    count: int,
    seed: int,
    robots: Sequence[str] = ("mgr", "mur"),
    rises_percent: Rises = (1.0, 60.0),
    least_of_several_percent: float = 5.0,
    runs: int = 100,
    steps: int = 40,
    reference_runs: int = 150,
    reference_vehicles: int = 1,
) -> list[Case]:
    """Draw cases of one family and kind; more of them change none of the first.

    All effects, or varieties of clean sessions, take turns in an order that is drawn anew each round; the errors that
    they cause are spread evenly over a logarithmic scale.

    Args:
        family: which physics play the robots.
        kind: what hides.
        count: how many.
        seed: of all that is drawn.
        robots: whose stand-ins.
        rises_percent: by how much effects alone are to raise the one-step error, from and to.
        least_of_several_percent: none of several that hide together raises it by less.
        runs: of a usual session.
        steps: transitions in its runs.
        reference_runs: of the recording that the simulation is learned from.
        reference_vehicles: that drove these.

    Raises:
        UserError: there is no such kind, or the family's engine is not there.
    """
    driver_of(family)
    if kind not in KINDS:
        raise UserError(f"no such kind of session: {kind!r}: {near_miss(kind, KINDS)}")
    length = {"runs": runs, "steps": steps, "reference_runs": reference_runs, "reference_vehicles": reference_vehicles}
    turns = _turns(family, kind, robots)
    drawn = []
    for number in range(count):
        rng = _rng(seed, family, kind, number)
        turn = number % len(turns)
        robot, word = turns[int(_rng(seed, family, kind, "order", number // len(turns)).permutation(len(turns))[turn])]
        names: tuple[str, ...] = ()
        variety = word
        low, high = rises_percent
        if kind in SIZES:
            names, variety = (word,), ""
        elif kind in ("two", "three"):
            names, variety, low = _several(family, robot, 2 if kind == "two" else 3, rng), "", least_of_several_percent
        rises = tuple(round(math.exp(one), 3) for one in rng.uniform(math.log(low), math.log(high), len(names)))
        own = int(rng.integers(2**31))
        case = Case(family=family, kind=kind, robot=robot, names=names, rises_percent=rises, variety=variety, seed=own)
        drawn.append(case.model_copy(update=length))
    return drawn


def _rng(seed: int, *names: object) -> np.random.Generator:
    return np.random.default_rng([seed, zlib.crc32("/".join(map(str, names)).encode())])


def _turns(family: Family, kind: Kind, robots: Sequence[str]) -> list[tuple[str, str]]:
    """Return (robot, effect or variety) of all that take turns.

    Raises:
        UserError: the family has a body for none of the robots.
    """
    robots = [robot for robot in robots if has_robot(family, robot)]
    if not robots:
        raise UserError(f"family {family!r} has none of these robots: leave it out, or give robots=[mgr]")
    if effects := SIZES.get(kind):
        known = {robot: _known(family, robot, effects) for robot in robots}
        return [(robot, name) for name in effects for robot in robots if name in known[robot]]
    if kind == "clean":
        return [(robot, name) for name, fits in VARIETIES.items() for robot in robots if robot in fits]
    return [(robot, "") for robot in robots]


def _known(family: Family, robot: str, effects: Mapping[str, Sizes]) -> list[str]:
    """Return the effects that a robot of a family can have."""
    possible = [name for name, sizes in effects.items() if robot in sizes]
    return [name for name in possible if has_effect(family, robot, name, effect_class(name))]


def _several(family: Family, robot: str, together: int, rng: np.random.Generator) -> tuple[str, ...]:
    """Draw different effects of the catalogue.

    A delay and a lag never hide together: at one period either passes for both.
    """
    known = _known(family, robot, CATALOGUE)
    while True:
        names = tuple(str(name) for name in rng.choice(known, together, replace=False))
        if not {"command_delay", "actuator_lag"} <= set(names):
            return names
