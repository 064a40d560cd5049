"""The sessions of the study: which effect hides in which of them, drawn from the study's seed."""

import zlib
from collections.abc import Iterator, Mapping, Sequence
from typing import Annotated, Any, Literal, get_args

import numpy as np
from pydantic import Field

from swarmtwin.commands.experiments.hidden_effects_sizes import CATALOGUE, OUTSIDE, Rng, Setting
from swarmtwin.errors import UserError, near_miss
from swarmtwin.robot import Positive, Robot, Seed, StrictModel
from swarmtwin.standin.operator import Manner
from swarmtwin.standin.session import PAUSE_S

Kind = Literal["single", "pair", "triple", "outside", "clean"]
KINDS: tuple[Kind, ...] = get_args(Kind)
Count = Annotated[int, Field(ge=1)]

VARIETIES = (
    *("plain", "gentle", "held", "waypoints", "short_runs", "long_runs"),
    *("few_runs", "pose_noise", "other_vehicle", "several_vehicles"),
)
"""Kinds of sessions with nothing wrong."""

TOGETHER: dict[Kind, int] = {"pair": 2, "triple": 3}
ALIKE = (frozenset({"command_delay", "actuator_lag"}),)
"""Causes that never hide together: at one period either passes for both."""

CLEAR = 0.5
QUICK: dict[Kind, int] = {"single": 6, "pair": 1, "triple": 1, "outside": 1, "clean": 2}
"""How many cases of each robot `cases=quick` keeps."""


class Counts(StrictModel):
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
    manner: Manner = "uniform"
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


def draw_cases(robots: Sequence[Robot], plan: Plan, counts: Counts, wanted: Sequence[str] | str) -> list[Case]:
    """Return the cases: `all`, `quick` (a few of each kind), or those of some kinds.

    Raises:
        UserError: there is no such kind.
    """
    kinds = KINDS if wanted in ("all", "quick") else tuple(wanted)
    for kind in kinds:
        if kind not in KINDS:
            raise UserError(f"cases: no such kind: {kind!r}: {near_miss(kind, ('all', 'quick', *KINDS))}")
    drawn = [
        case for kind in KINDS if kind in kinds for robot in robots for case in _of_kind(kind, robot, plan, counts)
    ]
    return _few(drawn, plan) if wanted == "quick" else drawn


def _few(cases: Sequence[Case], plan: Plan) -> list[Case]:
    chosen = []
    for robot in dict.fromkeys(case.robot for case in cases):
        for kind, count in QUICK.items():
            own = [case for case in cases if case.robot == robot and case.kind == kind]
            rows = plan.rng("quick", kind, robot).permutation(len(own))[:count]
            chosen += [own[row].model_copy(update={"reference": 0}) for row in rows]
    return chosen


def _of_kind(kind: Kind, robot: Robot, plan: Plan, counts: Counts) -> Iterator[Case]:
    count = getattr(counts, kind)
    if kind in TOGETHER:
        for index in range(count):
            yield several_effects(robot, plan, kind, index)
        return
    if kind == "clean":
        for variety in VARIETIES:
            for index in range(count):
                yield clean(robot, plan, variety, index)
        return
    for name, recipe in (CATALOGUE if kind == "single" else OUTSIDE).items():
        for index in range(count if robot.name in recipe.sizes else 0):
            share = (index + plan.rng("size", kind, name, robot.name, index).random()) / count
            yield one_effect(robot, plan, name, share, index)


def one_effect(robot: Robot, plan: Plan, name: str, share: float, index: int) -> Case:
    """Return a session with one effect of the catalogue or outside it, `share` of the way from faint to clear."""
    kind: Kind = "single" if name in CATALOGUE else "outside"
    return _with_effects(robot, plan, kind, [name], [share], plan.rng(kind, name, robot.name, index))


def several_effects(robot: Robot, plan: Plan, kind: Kind, index: int) -> Case:
    """Return a session with a `pair` or a `triple` of different effects of the catalogue, none of them faint."""
    together = TOGETHER[kind]
    rng = plan.rng(kind, robot.name, index)
    known = [name for name, recipe in CATALOGUE.items() if robot.name in recipe.sizes]
    while True:
        names = [str(name) for name in rng.choice(known, together, replace=False)]
        if not any(alike <= set(names) for alike in ALIKE):
            return _with_effects(robot, plan, kind, names, rng.uniform(CLEAR, 1.0, together), rng)


def _with_effects(
    robot: Robot,
    plan: Plan,
    kind: Kind,
    names: Sequence[str],
    shares: Sequence[float] | np.ndarray,
    rng: Rng,
) -> Case:
    vehicles = ("1", "2") if "neighbour_interaction" in names else ("1",)
    runs = max(1, plan.runs // len(vehicles))
    setting = setting_of(robot, runs, plan.steps)
    recipes: Mapping[str, Any] = CATALOGUE if kind != "outside" else OUTSIDE
    effects = [
        {"name": name, **recipes[name].draw(float(share), setting, rng)}
        for name, share in zip(names, shares, strict=True)
    ]
    return Case(
        kind=kind,
        variety="+".join(names),
        robot=robot.name,
        effects=tuple(effects),
        vehicles=vehicles,
        runs=runs,
        steps=plan.steps,
        seed=_seed(rng),
        reference=int(rng.integers(plan.references)),
    )


def setting_of(robot: Robot, runs: int, steps: int) -> Setting:
    """Return where the effects of a session are drawn for."""
    run_s = steps * robot.period_s + PAUSE_S
    return Setting(robot, run_s, runs * run_s)


def clean(robot: Robot, plan: Plan, variety: str, index: int) -> Case:
    """Return a session with nothing wrong, but unlike the reference as its variety says."""
    rng = plan.rng("clean", variety, robot.name, index)
    runs, steps = plan.runs, plan.steps
    about: dict[str, Any] = {"runs": runs, "steps": steps}
    others = [str(vehicle) for vehicle in rng.permutation(np.arange(2, 7))]
    if variety in ("gentle", "held", "waypoints"):
        about["manner"] = variety
    elif variety == "short_runs":
        about |= {"runs": 2 * runs, "steps": max(2, steps // 2)}
    elif variety == "long_runs":
        about |= {"runs": max(2, runs // 3), "steps": 3 * steps}
    elif variety == "few_runs":
        about["runs"] = max(2, round(runs * float(rng.uniform(0.25, 0.5))))
    elif variety == "pose_noise":
        about["pose_noise"] = round(float(rng.uniform(2.0, 3.0)), 3)
    elif variety == "other_vehicle":
        about["vehicles"] = (others[0],)
    elif variety == "several_vehicles":
        vehicles = ("1", *others[: int(rng.integers(1, 3))])
        about |= {"vehicles": vehicles, "runs": max(2, runs // len(vehicles))}
    seed, reference = _seed(rng), int(rng.integers(plan.references))
    return Case(kind="clean", variety=variety, robot=robot.name, effects=(), seed=seed, reference=reference, **about)


def _seed(rng: Rng) -> int:
    return int(rng.integers(2**31))
