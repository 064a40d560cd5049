"""The sessions of the study: which effect hides in which of them, drawn from the study's seed."""

import zlib
from collections.abc import Iterator, Sequence
from typing import Annotated, Any, Literal, get_args

import numpy as np
from pydantic import Field

from swarmtwin.errors import UserError, near_miss
from swarmtwin.robot import Positive, Robot, Seed, StrictModel
from swarmtwin.standin.drive_commands import CommandMode
from swarmtwin.standin.session import StandInSession
from swarmtwin.studies.hidden_effects.effect_sizes import CATALOGUE, OUTSIDE, draw_effect

Rng = np.random.Generator

Kind = Literal["single", "pair", "triple", "outside", "clean"]
KINDS: tuple[Kind, ...] = get_args(Kind)
Count = Annotated[int, Field(ge=1)]

VARIETIES = (
    *("plain", "gentle", "held", "waypoints", "short_runs", "long_runs"),
    *("few_runs", "pose_noise", "other_vehicle", "several_vehicles"),
)
"""Kinds of sessions with nothing wrong."""

TOGETHER: dict[Kind, int] = {"pair": 2, "triple": 3}
QUICK: dict[Kind, int] = {"single": 6, "pair": 1, "triple": 1, "outside": 1, "clean": 2}
"""How many cases of each robot `cases=quick` keeps."""


class CaseCounts(StrictModel):
    """How many cases there are: of each effect and robot, of each robot, of each kind of clean session and robot."""

    single: Count
    pair: Count
    triple: Count
    outside: Count
    clean: Count


class Case(StrictModel):
    """One session to diagnose.

    Attributes:
        kind: how many effects are hidden in it, and whether the catalogue knows them.
        variety: names of the effects, or which kind of clean session it is.
        robot: its name.
        effects: what is hidden, as in `record`.
        vehicles: ids of the vehicles; the reference is always of vehicle 1.
        manner: of choosing commands.
        runs: how many.
        steps: transitions in a run.
        pose_noise: the camera's noise over the usual one.
        seed: of everything random in the session and of its diagnosis.
        reference: which of the references it is compared with.
    """

    kind: Kind
    variety: str
    robot: str
    effects: tuple[dict[str, Any], ...]
    vehicles: tuple[str, ...] = ("1",)
    manner: CommandMode = "uniform"
    runs: Count
    steps: Count
    pose_noise: Positive = 1.0
    seed: Seed
    reference: int = 0

    @property
    def key(self) -> str:
        """What tells it from all other cases."""
        return self.model_dump_json()

    @property
    def true_names(self) -> tuple[str, ...]:
        """The causes that a diagnosis should name: none where the catalogue has no name."""
        return () if self.kind == "outside" else tuple(effect["name"] for effect in self.effects)


class Plan(StrictModel):
    """What all cases are drawn from.

    Attributes:
        seed: of the whole study.
        runs: of a usual session.
        steps: transitions in its runs.
        references: how many for each robot.
    """

    seed: Seed
    runs: Count
    steps: Count
    references: Count

    def rng(self, *names: object) -> Rng:
        """Return random numbers of their own for what is named, whatever else is drawn."""
        return np.random.default_rng([self.seed, zlib.crc32("/".join(map(str, names)).encode())])

    def at_last(self, rng: Rng) -> dict[str, int]:
        """Draw what comes last for every case: its seed, and which reference it is compared with."""
        return {"seed": int(rng.integers(2**31)), "reference": int(rng.integers(self.references))}


def draw_cases(robots: Sequence[Robot], plan: Plan, counts: CaseCounts, wanted: Sequence[str] | str) -> list[Case]:
    """Return the cases: `all`, `quick` (a few of each kind), or those of some kinds.

    Raises:
        UserError: there is no such kind.
    """
    kinds = KINDS if wanted in ("all", "quick") else tuple(wanted)
    for kind in kinds:
        if kind not in KINDS:
            raise UserError(f"cases: no such kind: {kind!r}: {near_miss(kind, ('all', 'quick', *KINDS))}")
    drawn = {
        (robot.name, kind): list(_of_kind(kind, robot, plan, getattr(counts, kind)))
        for kind in KINDS
        if kind in kinds
        for robot in robots
    }
    if wanted != "quick":
        return [case for own in drawn.values() for case in own]
    few = []
    for robot in robots:
        for kind, count in QUICK.items():
            own = drawn[robot.name, kind]
            rows = plan.rng("quick", kind, robot.name).permutation(len(own))[:count]
            few += [own[row].model_copy(update={"reference": 0}) for row in rows]
    return few


def _of_kind(kind: Kind, robot: Robot, plan: Plan, count: int) -> Iterator[Case]:
    if kind in TOGETHER:
        yield from (several_effects(robot, plan, kind, index) for index in range(count))
    elif kind == "clean":
        yield from (clean(robot, plan, variety, index) for variety in VARIETIES for index in range(count))
    else:
        for name, sizes in (CATALOGUE if kind == "single" else OUTSIDE).items():
            for index in range(count if robot.name in sizes else 0):
                share = (index + plan.rng("size", kind, name, robot.name, index).random()) / count
                yield one_effect(robot, plan, name, share, index)


def one_effect(robot: Robot, plan: Plan, name: str, share: float, index: int) -> Case:
    """Return a session with one effect of the catalogue or outside it, `share` of the way from faint to clear."""
    kind: Kind = "single" if name in CATALOGUE else "outside"
    return _with_effects(robot, plan, kind, {name: share}, plan.rng(kind, name, robot.name, index))


def several_effects(robot: Robot, plan: Plan, kind: Kind, index: int, least_share: float = 0.5) -> Case:
    """Return a session with a `pair` or a `triple` of different effects of the catalogue, none of them faint.

    A delay and a lag never hide together: at one period either passes for both.
    """
    together = TOGETHER[kind]
    rng = plan.rng(kind, robot.name, index)
    known = [name for name, sizes in CATALOGUE.items() if robot.name in sizes]
    while True:
        names = [str(name) for name in rng.choice(known, together, replace=False)]
        if not {"command_delay", "actuator_lag"} <= set(names):
            shares = rng.uniform(least_share, 1.0, together).tolist()
            return _with_effects(robot, plan, kind, dict(zip(names, shares, strict=True)), rng)


def _with_effects(robot: Robot, plan: Plan, kind: Kind, shares: dict[str, float], rng: Rng) -> Case:
    """Return a session with effects, each so far on the way from faint to clear."""
    vehicles = ("1", "2") if "neighbour_interaction" in shares else ("1",)
    runs = max(1, plan.runs // len(vehicles))
    run_s = plan.steps * robot.period_s + StandInSession.pause_s
    return Case(
        kind=kind,
        variety="+".join(shares),
        robot=robot.name,
        effects=tuple(draw_effect(name, share, robot, run_s, runs * run_s, rng) for name, share in shares.items()),
        vehicles=vehicles,
        runs=runs,
        steps=plan.steps,
        **plan.at_last(rng),
    )


def clean(robot: Robot, plan: Plan, variety: str, index: int) -> Case:
    """Return a session with nothing wrong, but unlike the reference as its variety says."""
    rng = plan.rng("clean", variety, robot.name, index)
    runs, steps = plan.runs, plan.steps
    others = [str(vehicle) for vehicle in rng.permutation(np.arange(2, 7))]
    about: dict[str, Any] = {"runs": runs, "steps": steps}
    match variety:
        case "gentle" | "held" | "waypoints":
            about |= {"manner": variety}
        case "short_runs":
            about |= {"runs": 2 * runs, "steps": max(2, steps // 2)}
        case "long_runs":
            about |= {"runs": max(2, runs // 3), "steps": 3 * steps}
        case "few_runs":
            about |= {"runs": max(2, round(runs * float(rng.uniform(0.25, 0.5))))}
        case "pose_noise":
            about |= {"pose_noise": round(float(rng.uniform(2.0, 3.0)), 3)}
        case "other_vehicle":
            about |= {"vehicles": (others[0],)}
        case "several_vehicles":
            vehicles = ("1", *others[: int(rng.integers(1, 3))])
            about |= {"vehicles": vehicles, "runs": max(2, runs // len(vehicles))}
    about |= plan.at_last(rng)
    return Case(kind="clean", variety=variety, robot=robot.name, effects=(), **about)
