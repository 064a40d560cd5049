"""How large hidden effects are: drawn so that the one-step error rises by 2 % up to more than 50 %."""

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np

from swarmtwin.robot import Robot
from swarmtwin.standin.effect import thrust_limit

Rng = np.random.Generator
Parameters = dict[str, Any]
DECIMALS = 5
LARGEST_BARREL = 0.28


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
        return self.robot.kinematics == "tail_fin"


@dataclass(frozen=True)
class Recipe:
    """How an effect's parameters are drawn.

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
        return {name: round(value, DECIMALS) for name, value in drawn.items()}


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


CATALOGUE: dict[str, Recipe] = {
    "gain_change": Recipe(
        {"mgr": (0.015, 0.18), "mur": (0.015, 0.2)}, lambda size, setting, rng: {"gain": 1.0 + size * _sign(rng)}
    ),
    "actuator_asymmetry": Recipe({"mgr": (0.05, 0.4), "mur": (0.02, 0.22)}, _ratio_or_angle),
    "dead_band": Recipe(
        {"mgr": (0.15, 0.36), "mur": (0.2, 0.6)},
        lambda size, setting, rng: {"width": size * thrust_limit(setting.robot)},
    ),
    "saturation": Recipe(
        {"mgr": (0.1, 0.38), "mur": (0.2, 0.6)},
        lambda size, setting, rng: {"limit": (1.0 - size) * thrust_limit(setting.robot)},
    ),
    "command_delay": Recipe({"mgr": (0.01, 0.08), "mur": (0.025, 0.18)}, lambda size, setting, rng: {"delay_s": size}),
    "actuator_lag": Recipe(
        {"mgr": (0.01, 0.09), "mur": (0.02, 0.18)}, lambda size, setting, rng: {"time_constant_s": size}
    ),
    "backlash": Recipe({"mgr": (1.5, 9.0), "mur": (0.06, 0.5)}, _play),
    "battery_sag": Recipe(
        {"mgr": (0.08, 0.42), "mur": (0.06, 0.45)},
        lambda size, setting, rng: {"loss": size, "shape": float(np.exp(rng.uniform(-0.7, 0.9)))},
    ),
    "surface_patch": Recipe({"mgr": (0.08, 0.4), "mur": (0.1, 0.7)}, _patch),
    "steady_drift": Recipe(
        {"mgr": (1.2, 8.0), "mur": (3.0, 16.0)},
        lambda size, setting, rng: {"speed_mm_s": size, "direction_rad": _direction(rng)},
    ),
    "wall_effect": Recipe(
        {"mgr": (0.2, 0.95), "mur": (0.15, 0.9)},
        lambda size, setting, rng: {"loss": size, "reach_mm": setting.side_mm * float(rng.uniform(0.1, 0.22))},
    ),
    "neighbour_interaction": Recipe(
        {"mgr": (8.0, 40.0), "mur": (20.0, 110.0)},
        lambda size, setting, rng: {
            "strength_mm_s": size * _sign(rng),
            "reach_mm": setting.side_mm * float(rng.uniform(0.12, 0.3)),
        },
    ),
    "camera_scale": Recipe(
        {"mgr": (0.025, 0.26), "mur": (0.015, 0.2)}, lambda size, setting, rng: {"scale": 1.0 + size * _sign(rng)}
    ),
    "lens_distortion": Recipe(
        {"mgr": (0.1, 0.45), "mur": (0.03, 0.28)},
        lambda size, setting, rng: {"coefficient": size * (_sign(rng) if size < LARGEST_BARREL else 1.0)},
    ),
    "marker_offset": Recipe({"mgr": (1.2, 9.0), "mur": (4.0, 28.0)}, _offset),
    "marker_yaw": Recipe(
        {"mgr": (0.025, 0.24), "mur": (0.05, 0.3)}, lambda size, setting, rng: {"angle_rad": size * _sign(rng)}
    ),
    "command_loss": Recipe(
        {"mgr": (0.003, 0.06), "mur": (0.006, 0.15)}, lambda size, setting, rng: {"probability": size}
    ),
    "timing_jitter": Recipe({"mgr": (0.03, 0.13), "mur": (0.05, 0.14)}, lambda size, setting, rng: {"spread": size}),
    "noise_change": Recipe({"mgr": (0.04, 0.9), "mur": (0.04, 0.9)}, lambda size, setting, rng: {"factor": 1.0 + size}),
}

OUTSIDE: dict[str, Recipe] = {
    "brushed_floor": Recipe(
        {"mgr": (0.06, 0.35), "mur": (0.06, 0.35)},
        lambda size, setting, rng: {"loss": size, "direction_rad": _direction(rng)},
    ),
    "striped_floor": Recipe(
        {"mgr": (0.06, 0.3), "mur": (0.06, 0.3)},
        lambda size, setting, rng: {"loss": size, "width_mm": setting.side_mm * float(rng.uniform(0.12, 0.2))},
    ),
    "oscillating_gain": Recipe(
        {"mgr": (0.05, 0.3), "mur": (0.05, 0.3)},
        lambda size, setting, rng: {"amplitude": size, "period_s": 60.0, "session_s": setting.session_s},
    ),
    "warm_up": Recipe(
        {"mgr": (0.15, 0.8), "mur": (0.15, 0.85)},
        lambda size, setting, rng: {
            "loss": size,
            "warm_after_s": 0.15 * setting.run_s,
            "run_s": setting.run_s,
            "session_s": setting.session_s,
        },
    ),
    "sudden_loss": Recipe(
        {"mgr": (0.06, 0.3), "mur": (0.05, 0.3)},
        lambda size, setting, rng: {"loss": size, "after": float(rng.uniform(0.35, 0.65))},
    ),
    "weak_left_turn": Recipe({"mgr": (0.08, 0.4), "mur": (0.1, 0.45)}, lambda size, setting, rng: {"loss": size}),
    "coarse_commands": Recipe(
        {"mgr": (0.1, 0.4), "mur": (0.2, 0.8)},
        lambda size, setting, rng: {"step": size * thrust_limit(setting.robot)},
    ),
    "bent_response": Recipe(
        {"mgr": (0.1, 0.6), "mur": (0.2, 0.85)}, lambda size, setting, rng: {"bend": size * _sign(rng)}
    ),
    "swapped_wheels": Recipe({"mgr": (0.006, 0.06)}, lambda size, setting, rng: {"probability": size}),
    "rotating_current": Recipe(
        {"mgr": (1.5, 9.0), "mur": (4.0, 20.0)},
        lambda size, setting, rng: {
            "speed_mm_s": size,
            "turns": float(rng.uniform(1.0, 3.0)),
            "direction_rad": _direction(rng),
        },
    ),
    "whirl": Recipe({"mgr": (3.0, 18.0), "mur": (5.0, 30.0)}, _around_middle),
    "bowl": Recipe({"mgr": (3.0, 20.0), "mur": (5.0, 30.0)}, _around_middle),
}
