"""The sessions of the study: which effect hides in which of them, drawn from the study's seed."""

import math
import zlib
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Annotated, Any, Literal, get_args

import numpy as np
from pydantic import Field

from swarmtwin.errors import UserError, near_miss
from swarmtwin.robot import Positive, Robot, Seed, StrictModel
from swarmtwin.standin.drive_commands import CommandMode
from swarmtwin.standin.effect import thrust_limit
from swarmtwin.standin.session import StandInSession

Rng = np.random.Generator
Parameters = dict[str, Any]


@dataclass(frozen=True)
class Setting:
    """Where an effect is drawn for.

    Attributes:
        robot: which robot drives.
        run_s: from the beginning of a run to that of the next.
        session_s: how long the session lasts by plan.
    """

    robot: Robot
    run_s: float
    session_s: float

    @property
    def side_mm(self) -> float:
        """The arena's smaller side."""
        return float(np.min(self.robot.arena_mm.high_mm - self.robot.arena_mm.low_mm))

    @property
    def is_fin(self) -> bool:
        """Whether the robot has a fin rather than wheels."""
        return self.robot.actuation.kind == "thrust"


@dataclass(frozen=True)
class EffectRange:
    """Which sizes of an effect are drawn, and which parameters an effect of that size has.

    Attributes:
        sizes: for each robot that it makes sense for, its faintest and its clearest size.
        parameters: of an effect of a size.
    """

    sizes: Mapping[str, tuple[float, float]]
    parameters: Callable[[float, Setting, Rng], Parameters]

    def draw(self, share: float, setting: Setting, rng: Rng) -> Parameters:
        """Return parameters; `share` of the way from the faintest to the clearest size, on a logarithmic scale."""
        low, high = self.sizes[setting.robot.name]
        drawn = self.parameters(low * (high / low) ** share, setting, rng)
        return {name: round(value, 5) for name, value in drawn.items()}


def _sign(rng: Rng) -> float:
    return float(rng.choice([-1.0, 1.0]))


def _direction(rng: Rng) -> float:
    return float(rng.uniform(-math.pi, math.pi))


def _ratio_or_angle(size: float, setting: Setting, rng: Rng) -> Parameters:
    if setting.is_fin:
        return {"angle_rad": size * _sign(rng)}
    return {"ratio": (1.0 + size) ** _sign(rng)}


def _play(size: float, setting: Setting, rng: Rng) -> Parameters:
    return {"travel_rad" if setting.is_fin else "travel_mm": size}


def _patch(size: float, setting: Setting, rng: Rng) -> Parameters:
    low, high = setting.robot.arena_mm.low_mm, setting.robot.arena_mm.high_mm
    x_mm, y_mm = low + (high - low) * rng.uniform(0.25, 0.75, 2)
    radius_mm = setting.side_mm * rng.uniform(0.18, 0.32)
    return {"x_mm": float(x_mm), "y_mm": float(y_mm), "radius_mm": float(radius_mm), "loss": size}


def _offset(size: float, setting: Setting, rng: Rng) -> Parameters:
    direction_rad = _direction(rng)
    return {"forward_mm": size * math.cos(direction_rad), "left_mm": size * math.sin(direction_rad)}


def _around_middle(size: float, setting: Setting, rng: Rng) -> Parameters:
    arena = setting.robot.arena_mm
    x_mm, y_mm = ((arena.low_mm + arena.high_mm) / 2).tolist()
    return {"speed_mm_s": size * _sign(rng), "x_mm": x_mm, "y_mm": y_mm, "radius_mm": setting.side_mm / 2}


CATALOGUE: dict[str, EffectRange] = {
    "gain_change": EffectRange(
        {"mgr": (0.015, 0.18), "mur": (0.015, 0.2)}, lambda size, setting, rng: {"gain": 1.0 + size * _sign(rng)}
    ),
    "actuator_asymmetry": EffectRange({"mgr": (0.05, 0.4), "mur": (0.02, 0.22)}, _ratio_or_angle),
    "dead_band": EffectRange(
        {"mgr": (0.15, 0.36), "mur": (0.2, 0.6)},
        lambda size, setting, rng: {"width": size * thrust_limit(setting.robot)},
    ),
    "saturation": EffectRange(
        {"mgr": (0.1, 0.38), "mur": (0.2, 0.6)},
        lambda size, setting, rng: {"limit": (1.0 - size) * thrust_limit(setting.robot)},
    ),
    "command_delay": EffectRange(
        {"mgr": (0.01, 0.08), "mur": (0.025, 0.18)}, lambda size, setting, rng: {"delay_s": size}
    ),
    "actuator_lag": EffectRange(
        {"mgr": (0.01, 0.09), "mur": (0.02, 0.18)}, lambda size, setting, rng: {"time_constant_s": size}
    ),
    "backlash": EffectRange({"mgr": (1.5, 9.0), "mur": (0.06, 0.5)}, _play),
    "battery_sag": EffectRange(
        {"mgr": (0.08, 0.42), "mur": (0.06, 0.45)},
        lambda size, setting, rng: {"loss": size, "shape": float(np.exp(rng.uniform(-0.7, 0.9)))},
    ),
    "surface_patch": EffectRange({"mgr": (0.08, 0.4), "mur": (0.1, 0.7)}, _patch),
    "steady_drift": EffectRange(
        {"mgr": (1.2, 8.0), "mur": (3.0, 16.0)},
        lambda size, setting, rng: {"speed_mm_s": size, "direction_rad": _direction(rng)},
    ),
    "wall_effect": EffectRange(
        {"mgr": (0.2, 0.95), "mur": (0.15, 0.9)},
        lambda size, setting, rng: {"loss": size, "reach_mm": setting.side_mm * float(rng.uniform(0.1, 0.22))},
    ),
    "neighbour_interaction": EffectRange(
        {"mgr": (8.0, 40.0), "mur": (20.0, 110.0)},
        lambda size, setting, rng: {
            "strength_mm_s": size * _sign(rng),
            "reach_mm": setting.side_mm * float(rng.uniform(0.12, 0.3)),
        },
    ),
    "camera_scale": EffectRange(
        {"mgr": (0.025, 0.26), "mur": (0.015, 0.2)}, lambda size, setting, rng: {"scale": 1.0 + size * _sign(rng)}
    ),
    "lens_distortion": EffectRange(
        {"mgr": (0.1, 0.45), "mur": (0.03, 0.28)},
        # a lens that shrinks the picture's edge by more than 0.28 would fold it over
        lambda size, setting, rng: {"coefficient": size * (_sign(rng) if size < 0.28 else 1.0)},
    ),
    "marker_offset": EffectRange({"mgr": (1.2, 9.0), "mur": (4.0, 28.0)}, _offset),
    "marker_yaw": EffectRange(
        {"mgr": (0.025, 0.24), "mur": (0.05, 0.3)}, lambda size, setting, rng: {"angle_rad": size * _sign(rng)}
    ),
    "command_loss": EffectRange(
        {"mgr": (0.003, 0.06), "mur": (0.006, 0.15)}, lambda size, setting, rng: {"probability": size}
    ),
    "timing_jitter": EffectRange(
        {"mgr": (0.03, 0.13), "mur": (0.05, 0.14)}, lambda size, setting, rng: {"spread": size}
    ),
    "noise_change": EffectRange(
        {"mgr": (0.04, 0.9), "mur": (0.04, 0.9)}, lambda size, setting, rng: {"factor": 1.0 + size}
    ),
}

OUTSIDE: dict[str, EffectRange] = {
    "brushed_floor": EffectRange(
        {"mgr": (0.06, 0.35), "mur": (0.06, 0.35)},
        lambda size, setting, rng: {"loss": size, "direction_rad": _direction(rng)},
    ),
    "striped_floor": EffectRange(
        {"mgr": (0.06, 0.3), "mur": (0.06, 0.3)},
        lambda size, setting, rng: {"loss": size, "width_mm": setting.side_mm * float(rng.uniform(0.12, 0.2))},
    ),
    "oscillating_gain": EffectRange(
        {"mgr": (0.05, 0.3), "mur": (0.05, 0.3)},
        lambda size, setting, rng: {"amplitude": size, "period_s": 60.0, "session_s": setting.session_s},
    ),
    "warm_up": EffectRange(
        {"mgr": (0.15, 0.8), "mur": (0.15, 0.85)},
        lambda size, setting, rng: {
            "loss": size,
            "warm_after_s": 0.15 * setting.run_s,
            "run_s": setting.run_s,
            "session_s": setting.session_s,
        },
    ),
    "sudden_loss": EffectRange(
        {"mgr": (0.06, 0.3), "mur": (0.05, 0.3)},
        lambda size, setting, rng: {"loss": size, "after": float(rng.uniform(0.35, 0.65))},
    ),
    "weak_left_turn": EffectRange({"mgr": (0.08, 0.4), "mur": (0.1, 0.45)}, lambda size, setting, rng: {"loss": size}),
    "coarse_commands": EffectRange(
        {"mgr": (0.1, 0.4), "mur": (0.2, 0.8)},
        lambda size, setting, rng: {"step": size * thrust_limit(setting.robot)},
    ),
    "bent_response": EffectRange(
        {"mgr": (0.1, 0.6), "mur": (0.2, 0.85)}, lambda size, setting, rng: {"bend": size * _sign(rng)}
    ),
    "swapped_wheels": EffectRange({"mgr": (0.006, 0.06)}, lambda size, setting, rng: {"probability": size}),
    "rotating_current": EffectRange(
        {"mgr": (1.5, 9.0), "mur": (4.0, 20.0)},
        lambda size, setting, rng: {
            "speed_mm_s": size,
            "turns": float(rng.uniform(1.0, 3.0)),
            "direction_rad": _direction(rng),
        },
    ),
    "whirl": EffectRange({"mgr": (3.0, 18.0), "mur": (5.0, 30.0)}, _around_middle),
    "bowl": EffectRange({"mgr": (3.0, 20.0), "mur": (5.0, 30.0)}, _around_middle),
}


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


def draw_cases(robots: Sequence[Robot], plan: Plan, counts: CaseCounts, wanted: Sequence[str] | str) -> list[Case]:
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


def _of_kind(kind: Kind, robot: Robot, plan: Plan, counts: CaseCounts) -> Iterator[Case]:
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
    for name, effect in (CATALOGUE if kind == "single" else OUTSIDE).items():
        for index in range(count if robot.name in effect.sizes else 0):
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
    known = [name for name, effect in CATALOGUE.items() if robot.name in effect.sizes]
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
    ranges: Mapping[str, Any] = CATALOGUE if kind != "outside" else OUTSIDE
    effects = [
        {"name": name, **ranges[name].draw(float(share), setting, rng)}
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
    run_s = steps * robot.period_s + StandInSession.pause_s
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
