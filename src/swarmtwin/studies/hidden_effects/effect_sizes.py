"""Effects of the catalogue that the study hides: how large they may be, and what parameters one of a size has."""

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
    def middle_mm(self) -> tuple[float, float]:
        """The arena's middle."""
        x_mm, y_mm = ((self.robot.arena_mm.low_mm + self.robot.arena_mm.high_mm) / 2).tolist()
        return x_mm, y_mm

    @property
    def is_fin(self) -> bool:
        """Whether the robot has a fin rather than wheels."""
        return self.robot.actuation.kind == "thrust"

    @property
    def full_thrust(self) -> float:
        """The largest command of an actuator that thrusts."""
        return thrust_limit(self.robot)

    @property
    def top_speed_mm_s(self) -> float:
        """How fast the robot goes by full commands."""
        return self.robot.largest_displacement.forward_mm / self.robot.period_s

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


Sizes = Mapping[str, tuple[float, float]]

CATALOGUE: dict[str, Sizes] = {
    "gain_change": {"mgr": (0.003, 0.45), "mur": (0.003, 0.5)},
    "actuator_asymmetry": {"mgr": (0.008, 1.2), "mur": (0.004, 0.6)},
    "dead_band": {"mgr": (0.02, 0.7), "mur": (0.03, 0.9)},
    "saturation": {"mgr": (0.02, 0.8), "mur": (0.04, 0.85)},
    "command_delay": {"mgr": (0.002, 0.25), "mur": (0.004, 0.4)},
    "actuator_lag": {"mgr": (0.002, 0.3), "mur": (0.004, 0.6)},
    "backlash": {"mgr": (0.2, 30.0), "mur": (0.01, 0.95)},
    "battery_sag": {"mgr": (0.01, 0.8), "mur": (0.01, 0.8)},
    "surface_patch": {"mgr": (0.02, 0.95), "mur": (0.02, 0.95)},
    "steady_drift": {"mgr": (0.2, 30.0), "mur": (0.4, 50.0)},
    "wall_effect": {"mgr": (0.03, 0.98), "mur": (0.03, 0.98)},
    "neighbour_interaction": {"mgr": (1.0, 150.0), "mur": (2.0, 190.0)},
    "camera_scale": {"mgr": (0.004, 0.5), "mur": (0.003, 0.45)},
    "lens_distortion": {"mgr": (0.015, 0.5), "mur": (0.008, 0.45)},
    "marker_offset": {"mgr": (0.2, 40.0), "mur": (0.5, 70.0)},
    "marker_yaw": {"mgr": (0.005, 0.8), "mur": (0.008, 0.9)},
    "command_loss": {"mgr": (0.0005, 0.4), "mur": (0.001, 0.5)},
    "timing_jitter": {"mgr": (0.004, 0.13), "mur": (0.005, 0.14)},
    "noise_change": {"mgr": (0.005, 3.5), "mur": (0.005, 3.5)},
}
"""Effects that the diagnosis knows as causes: for each robot that can have them the smallest size, which nobody can
see, and the largest that still makes sense. Which one is hidden follows from the error that it is to cause."""

PARAMETERS: dict[str, Callable[[Draw], dict[str, Any]]] = {
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
}
"""The parameters of an effect, from its size and what is left to chance."""
