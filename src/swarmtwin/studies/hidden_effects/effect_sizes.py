"""How large the effects are that the study hides, and which parameters an effect of a size has: data alone."""

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np

from swarmtwin.robot import Robot
from swarmtwin.standin.effect import thrust_limit


@dataclass(frozen=True)
class Draw:
    """An effect of some size, drawn for a session.

    Attributes:
        size: of the effect.
        robot: which robot drives.
        run_s: from the beginning of a run to that of the next.
        session_s: how long the session lasts by plan.
        rng: of all that is left to chance.
    """

    size: float
    robot: Robot
    run_s: float
    session_s: float
    rng: np.random.Generator

    @property
    def side_mm(self) -> float:
        """The arena's smaller side."""
        return float(np.min(self.robot.arena_mm.high_mm - self.robot.arena_mm.low_mm))

    @property
    def is_fin(self) -> bool:
        """Whether the robot has a fin rather than wheels."""
        return self.robot.actuation.kind == "thrust"

    @property
    def full_thrust(self) -> float:
        """The largest command of an actuator that thrusts."""
        return thrust_limit(self.robot)

    def sign(self) -> float:
        """Draw 1 or −1."""
        return float(self.rng.choice([-1.0, 1.0]))

    def uniform(self, low: float, high: float) -> float:
        """Draw a number between two."""
        return float(self.rng.uniform(low, high))

    def direction_rad(self) -> float:
        """Draw a direction."""
        return self.uniform(-math.pi, math.pi)


def _patch(drawn: Draw) -> dict[str, float]:
    low, high = drawn.robot.arena_mm.low_mm, drawn.robot.arena_mm.high_mm
    x_mm, y_mm = (low + (high - low) * drawn.rng.uniform(0.25, 0.75, 2)).tolist()
    return {"x_mm": x_mm, "y_mm": y_mm, "radius_mm": drawn.side_mm * drawn.uniform(0.18, 0.32), "loss": drawn.size}


def _offset(drawn: Draw) -> dict[str, float]:
    direction_rad = drawn.direction_rad()
    return {"forward_mm": drawn.size * math.cos(direction_rad), "left_mm": drawn.size * math.sin(direction_rad)}


def _warm_up(drawn: Draw) -> dict[str, float]:
    lasts = {"run_s": drawn.run_s, "session_s": drawn.session_s}
    return {"loss": drawn.size, "warm_after_s": 0.15 * drawn.run_s, **lasts}


def _rotating_current(drawn: Draw) -> dict[str, float]:
    turns = drawn.uniform(1.0, 3.0)
    return {"speed_mm_s": drawn.size, "turns": turns, "direction_rad": drawn.direction_rad()}


def _around_middle(drawn: Draw) -> dict[str, float]:
    arena = drawn.robot.arena_mm
    x_mm, y_mm = ((arena.low_mm + arena.high_mm) / 2).tolist()
    return {"speed_mm_s": drawn.size * drawn.sign(), "x_mm": x_mm, "y_mm": y_mm, "radius_mm": drawn.side_mm / 2}


Sizes = Mapping[str, tuple[float, float]]

CATALOGUE: dict[str, Sizes] = {
    "gain_change": {"mgr": (0.015, 0.18), "mur": (0.015, 0.2)},
    "actuator_asymmetry": {"mgr": (0.05, 0.4), "mur": (0.02, 0.22)},
    "dead_band": {"mgr": (0.15, 0.36), "mur": (0.2, 0.6)},
    "saturation": {"mgr": (0.1, 0.38), "mur": (0.2, 0.6)},
    "command_delay": {"mgr": (0.01, 0.08), "mur": (0.025, 0.18)},
    "actuator_lag": {"mgr": (0.01, 0.09), "mur": (0.02, 0.18)},
    "backlash": {"mgr": (1.5, 9.0), "mur": (0.06, 0.5)},
    "battery_sag": {"mgr": (0.08, 0.42), "mur": (0.06, 0.45)},
    "surface_patch": {"mgr": (0.08, 0.4), "mur": (0.1, 0.7)},
    "steady_drift": {"mgr": (1.2, 8.0), "mur": (3.0, 16.0)},
    "wall_effect": {"mgr": (0.2, 0.95), "mur": (0.15, 0.9)},
    "neighbour_interaction": {"mgr": (8.0, 40.0), "mur": (20.0, 110.0)},
    "camera_scale": {"mgr": (0.025, 0.26), "mur": (0.015, 0.2)},
    "lens_distortion": {"mgr": (0.1, 0.45), "mur": (0.03, 0.28)},
    "marker_offset": {"mgr": (1.2, 9.0), "mur": (4.0, 28.0)},
    "marker_yaw": {"mgr": (0.025, 0.24), "mur": (0.05, 0.3)},
    "command_loss": {"mgr": (0.003, 0.06), "mur": (0.006, 0.15)},
    "timing_jitter": {"mgr": (0.03, 0.13), "mur": (0.05, 0.14)},
    "noise_change": {"mgr": (0.04, 0.9), "mur": (0.04, 0.9)},
}
"""Effects that the diagnosis knows as causes: the faintest and the clearest size for each robot that can have them."""

OUTSIDE: dict[str, Sizes] = {
    "brushed_floor": {"mgr": (0.06, 0.35), "mur": (0.06, 0.35)},
    "striped_floor": {"mgr": (0.06, 0.3), "mur": (0.06, 0.3)},
    "oscillating_gain": {"mgr": (0.05, 0.3), "mur": (0.05, 0.3)},
    "warm_up": {"mgr": (0.15, 0.8), "mur": (0.15, 0.85)},
    "sudden_loss": {"mgr": (0.06, 0.3), "mur": (0.05, 0.3)},
    "weak_left_turn": {"mgr": (0.08, 0.4), "mur": (0.1, 0.45)},
    "coarse_commands": {"mgr": (0.1, 0.4), "mur": (0.2, 0.8)},
    "bent_response": {"mgr": (0.1, 0.6), "mur": (0.2, 0.85)},
    "swapped_wheels": {"mgr": (0.006, 0.06)},
    "rotating_current": {"mgr": (1.5, 9.0), "mur": (4.0, 20.0)},
    "whirl": {"mgr": (3.0, 18.0), "mur": (5.0, 30.0)},
    "bowl": {"mgr": (3.0, 20.0), "mur": (5.0, 30.0)},
}
"""Likewise effects that no cause describes, those of `outside_effects.py`."""

PARAMETERS: dict[str, Callable[[Draw], dict[str, float]]] = {
    "gain_change": lambda drawn: {"gain": 1.0 + drawn.size * drawn.sign()},
    "actuator_asymmetry": lambda drawn: (
        {"angle_rad": drawn.size * drawn.sign()} if drawn.is_fin else {"ratio": (1.0 + drawn.size) ** drawn.sign()}
    ),
    "dead_band": lambda drawn: {"width": drawn.size * drawn.full_thrust},
    "saturation": lambda drawn: {"limit": (1.0 - drawn.size) * drawn.full_thrust},
    "command_delay": lambda drawn: {"delay_s": drawn.size},
    "actuator_lag": lambda drawn: {"time_constant_s": drawn.size},
    "backlash": lambda drawn: {"travel_rad" if drawn.is_fin else "travel_mm": drawn.size},
    "battery_sag": lambda drawn: {"loss": drawn.size, "shape": math.exp(drawn.uniform(-0.7, 0.9))},
    "surface_patch": _patch,
    "steady_drift": lambda drawn: {"speed_mm_s": drawn.size, "direction_rad": drawn.direction_rad()},
    "wall_effect": lambda drawn: {"loss": drawn.size, "reach_mm": drawn.side_mm * drawn.uniform(0.1, 0.22)},
    "neighbour_interaction": lambda drawn: {
        "strength_mm_s": drawn.size * drawn.sign(),
        "reach_mm": drawn.side_mm * drawn.uniform(0.12, 0.3),
    },
    "camera_scale": lambda drawn: {"scale": 1.0 + drawn.size * drawn.sign()},
    # a lens that shrinks the picture's edge by more than 0.28 would fold it over
    "lens_distortion": lambda drawn: {"coefficient": drawn.size * (drawn.sign() if drawn.size < 0.28 else 1.0)},
    "marker_offset": _offset,
    "marker_yaw": lambda drawn: {"angle_rad": drawn.size * drawn.sign()},
    "command_loss": lambda drawn: {"probability": drawn.size},
    "timing_jitter": lambda drawn: {"spread": drawn.size},
    "noise_change": lambda drawn: {"factor": 1.0 + drawn.size},
    "brushed_floor": lambda drawn: {"loss": drawn.size, "direction_rad": drawn.direction_rad()},
    "striped_floor": lambda drawn: {"loss": drawn.size, "width_mm": drawn.side_mm * drawn.uniform(0.12, 0.2)},
    "oscillating_gain": lambda drawn: {"amplitude": drawn.size, "period_s": 60.0, "session_s": drawn.session_s},
    "warm_up": _warm_up,
    "sudden_loss": lambda drawn: {"loss": drawn.size, "after": drawn.uniform(0.35, 0.65)},
    "weak_left_turn": lambda drawn: {"loss": drawn.size},
    "coarse_commands": lambda drawn: {"step": drawn.size * drawn.full_thrust},
    "bent_response": lambda drawn: {"bend": drawn.size * drawn.sign()},
    "swapped_wheels": lambda drawn: {"probability": drawn.size},
    "rotating_current": _rotating_current,
    "whirl": _around_middle,
    "bowl": _around_middle,
}
"""The parameters of an effect, from its size and what is left to chance."""


def draw_effect(
    name: str, share: float, robot: Robot, run_s: float, session_s: float, rng: np.random.Generator
) -> dict[str, Any]:
    """Return an effect as `record` takes it, `share` of the way from faint to clear on a logarithmic scale."""
    low, high = {**CATALOGUE, **OUTSIDE}[name][robot.name]
    drawn = Draw(low * (high / low) ** share, robot, run_s, session_s, rng)
    return {"name": name, **{key: round(value, 5) for key, value in PARAMETERS[name](drawn).items()}}
