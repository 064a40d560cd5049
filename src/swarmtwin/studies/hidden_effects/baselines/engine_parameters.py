"""What `mujoco.sysid` may change of a rigid-body model, and which changes are which cause of the catalogue."""

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from swarmtwin.standin.rigid_body.car import Car
from swarmtwin.standin.rigid_body.swimmer import Swimmer


class Freedom(NamedTuple):
    """A parameter of the model: its nominal value, its bounds, and by how much it is changed to see what that does."""

    nominal: float
    low: float
    high: float
    step: float


def _factors(*names: str) -> dict[str, Freedom]:
    return {name: Freedom(1.0, 0.2, 4.0, 0.02) for name in names}


BODY: dict[str, dict[str, Freedom]] = {
    "mgr": {
        **_factors("left_motor", "right_motor", "left_radius", "right_radius", "left_friction", "right_friction"),
        **_factors("track", "mass", "caster_grip", "tyre_grip", "resistance"),
        "rotor": Freedom(1.0, 0.2, 15.0, 0.1),
    },
    "mur": {
        **_factors("mass", "drag", "stiffness", "chord", "span", "trim"),
        **_factors("servo_gain", "servo_damping", "bend_damping", "plate_mass", "tail_mass"),
        "setting_s": Freedom(1.0, 0.2, 15.0, 0.1),
    },
}
"""Properties of each body that are free, over their true values. A gear is the motors' over again."""

_EVERYWHERE = {
    "carried_x_mm_s": Freedom(0.0, -60.0, 60.0, 0.5),
    "carried_y_mm_s": Freedom(0.0, -60.0, 60.0, 0.5),
    "marker_forward_mm": Freedom(0.0, -90.0, 90.0, 1.0),
    "marker_left_mm": Freedom(0.0, -90.0, 90.0, 1.0),
    "marker_rad": Freedom(0.0, -1.2, 1.2, 0.01),
    "camera_gain": Freedom(1.0, 0.51, 1.9, 0.01),
    "delay_s": Freedom(0.0, 0.0, 0.45, 0.005),
}

SETTING: dict[str, dict[str, Freedom]] = {
    "mgr": {**_EVERYWHERE, "voltage_ratio": Freedom(1.0, 0.31, 2.9, 0.02)},
    "mur": {**_EVERYWHERE, "stroke": Freedom(1.0, 0.2, 2.0, 0.02)},
}
"""What is free beside the body: the velocity of floor or water, where the marker sits, and what the toolbox knows as
gains of sensors, gains of controls (voltage left over right, the fin's stroke) and delays of controls."""


@dataclass(frozen=True)
class Reading:
    """Which changes of the model's parameters a cause makes.

    Attributes:
        name: of the cause.
        directions: for each of the k sizes of the cause what one unit of it adds to the model's parameters.
        told: the cause's own parameters, given the sizes (k,); none where the model has another law of it.
        least: below which no size makes sense.
    """

    name: str
    directions: tuple[Mapping[str, float], ...]
    told: Callable[[np.ndarray], dict[str, float]]
    least: float = -math.inf


def readings(robot: str) -> tuple[Reading, ...]:
    """Return how causes are read off a robot's model."""
    return (*(_of_the_car() if robot == "mgr" else _of_the_swimmer()), *_of_the_setting())


def _of_the_car() -> tuple[Reading, ...]:
    rotor_per_s = Car.motor_constant**2 / (Car.resistance * Car.rotor_inertia)
    return (
        Reading("gain_change", ({"left_radius": 1.0, "right_radius": 1.0},), _read_as("gain", 1.0)),
        Reading("actuator_asymmetry", ({"voltage_ratio": 1.0},), _read_as("ratio", 1.0)),
        Reading("dead_band", ({"left_friction": 1.0, "right_friction": 1.0},), lambda sizes: {}, 0.0),
        Reading("actuator_lag", ({"rotor": rotor_per_s},), _read_as("time_constant_s"), 0.0),
    )


def _of_the_swimmer() -> tuple[Reading, ...]:
    return (
        Reading("gain_change", ({"stroke": 1.0},), _read_as("gain", 1.0)),
        Reading("actuator_asymmetry", ({"trim": 1.0},), _read_as("angle_rad")),
        Reading("actuator_lag", ({"setting_s": 1.0 / Swimmer.setting_s},), _read_as("time_constant_s"), 0.0),
    )


def _of_the_setting() -> tuple[Reading, ...]:
    return (
        Reading("steady_drift", ({"carried_x_mm_s": 1.0}, {"carried_y_mm_s": 1.0}), _told_drift),
        Reading("marker_offset", ({"marker_forward_mm": 1.0}, {"marker_left_mm": 1.0}), _told_offset),
        Reading("marker_yaw", ({"marker_rad": 1.0},), _read_as("angle_rad")),
        Reading("camera_scale", ({"camera_gain": 1.0},), _read_as("scale", 1.0)),
        Reading("command_delay", ({"delay_s": 1.0},), _read_as("delay_s"), 0.0),
    )


def _read_as(name: str, nothing: float = 0.0) -> Callable[[np.ndarray], dict[str, float]]:
    return lambda sizes: {name: nothing + float(sizes[0])}


def _told_drift(sizes: np.ndarray) -> dict[str, float]:
    return {"speed_mm_s": math.hypot(*sizes), "direction_rad": math.atan2(sizes[1], sizes[0])}


def _told_offset(sizes: np.ndarray) -> dict[str, float]:
    return {"forward_mm": float(sizes[0]), "left_mm": float(sizes[1])}
