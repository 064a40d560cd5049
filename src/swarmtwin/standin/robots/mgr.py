"""The stand-in Micro-Ground Robot: two geared motors on PWM, no encoders (paper, section 4.1.1)."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, ClassVar, Self

import numpy as np

from swarmtwin.standin.character import Character
from swarmtwin.standin.effect import Stroke
from swarmtwin.standin.physics import Physics, Surroundings, Unit, fabricate, take_up


@dataclass(frozen=True)
class MgrUnit(Unit):
    """What differs from unit to unit. Wheel properties are (2, 1, V), left then right; the others (V,).

    Attributes:
        spreads: standard deviation of each property's factor, in the order in which they are drawn.
        speed_mm_s: of a wheel's rim at full PWM: wheel radius and motor constant together.
        dead_band_pwm: below it a motor does not turn.
        time_constant_s: of a motor's speed.
        track_mm: distance between the wheels.
    """

    spreads: ClassVar[Mapping[str, float]] = {
        "left_speed": 0.02,
        "right_speed": 0.02,
        "left_dead_band": 0.05,
        "right_dead_band": 0.05,
        "time_constant": 0.05,
        "track": 0.015,
    }

    speed_mm_s: np.ndarray
    dead_band_pwm: np.ndarray
    time_constant_s: np.ndarray
    track_mm: np.ndarray

    @classmethod
    def as_drawn(cls, vehicle_count: int = 1, dtype: Any = np.float64) -> Self:
        """Return units exactly as on the drawing, left and right alike."""
        wheel, vehicle = np.ones((2, 1, vehicle_count), dtype), np.ones(vehicle_count, dtype)
        return cls(wheel * 102.0, wheel * 12.0, vehicle * 0.055, vehicle * 72.0)

    @classmethod
    def of(cls, vehicles: Sequence[str], dtype: Any = np.float64) -> Self:
        """Return the units with these ids."""
        drawn = cls.as_drawn(len(vehicles))
        factor = fabricate("mgr", vehicles, cls.spreads)
        speed = np.stack([factor["left_speed"], factor["right_speed"]])[:, None]
        dead_band = np.stack([factor["left_dead_band"], factor["right_dead_band"]])[:, None]
        return cls(
            (drawn.speed_mm_s * speed).astype(dtype),
            (drawn.dead_band_pwm * dead_band).astype(dtype),
            (drawn.time_constant_s * factor["time_constant"]).astype(dtype),
            (drawn.track_mm * factor["track"]).astype(dtype),
        )


class StandIn(Physics):
    """PWM → wheel speed → slip → motion of the body, at 0.02 s.

    Attributes:
        full_pwm: the largest command.
        curvature: how much the motor curve flattens towards full PWM.
        slip: share of the wheels' travel that is lost on the ground.
        slip_noise_sqrt_s: random part of it: standard deviation over one second, as a share of the travel.
        skid_s: velocity outwards in a curve, per centripetal acceleration.
    """

    unit: MgrUnit
    unit_class = MgrUnit
    command_columns = ("left", "right")
    states = ("x_mm", "y_mm", "heading_rad", "left_mm_s", "right_mm_s", "left_slack_mm", "right_slack_mm")
    substeps = 25
    noises = 2
    position_noise_mm = 1.0
    heading_noise_rad = 0.020
    resting_command = (0.0, 0.0)
    memory_of_place = False
    latent_draws = 64

    unruly = Character(
        motion_freedom=2.6,
        camera_freedom=4.0,
        noise_factor=1.4,
        marker_mm=(10.0, 0.0),
        marker_spread_mm=1.0,
        delay_s=0.02,
        loss_probability=0.004,
        jitter=0.01,
    )

    full_pwm = 120.0
    curvature = 0.35
    slip = 0.04
    slip_noise_sqrt_s = 0.076
    skid_s = 0.03

    def target(self, command: np.ndarray, strength: Any) -> np.ndarray:
        """Return the speeds (2, ...) in mm/s that the wheels tend to: a dead-band, then a curve that flattens."""
        effort = np.abs(command) - self.unit.dead_band_pwm
        effort = np.maximum(effort, 0.0) / (self.full_pwm - self.unit.dead_band_pwm)
        curve = effort * (1.0 + self.curvature) / (1.0 + self.curvature * effort)
        return np.sign(command) * curve * self.unit.speed_mm_s * strength

    def step(
        self,
        state: np.ndarray,
        target: np.ndarray,
        dt_s: Any,
        surroundings: Surroundings,
        noise: np.ndarray | None,
    ) -> np.ndarray:
        """Advance the motors exactly (first-order lag) and the body by the midpoint rule."""
        heading_rad, wheels_mm_s = state[2], state[3:5]
        lag_s = self.unit.time_constant_s + self.conditions.lag_s
        fading = np.exp(-dt_s / lag_s)
        target = self.conditions.aimed_speed(target, wheels_mm_s)
        excess = wheels_mm_s - target
        travel = target * dt_s + excess * (lag_s * (1.0 - fading))
        if noise is not None:
            travel = travel * (1.0 + self.slip_noise_sqrt_s * self.conditions.noise_factor / np.sqrt(dt_s) * noise)
        after = np.empty_like(state)
        after[3:5] = target + excess * fading
        after[5:7] = state[5:7]
        if self.conditions.rolls:
            travel, after[7:] = self.conditions.roll(Stroke(travel, wheels_mm_s, after[3:5], dt_s), state[7:])
        if self.conditions.backlash:
            after[5:7], travel = take_up(state[5:7], travel, self.conditions.backlash)
        travel = travel * (surroundings.traction * (1.0 - self.slip))
        forward_mm = (travel[0] + travel[1]) * 0.5
        turn_rad = (travel[1] - travel[0]) / self.unit.track_mm
        left_mm = forward_mm * turn_rad * (-self.skid_s / dt_s)
        middle_rad = heading_rad + turn_rad * 0.5
        cos, sin = np.cos(middle_rad), np.sin(middle_rad)
        after[0] = state[0] + cos * forward_mm - sin * left_mm + surroundings.carried_x_mm_s * dt_s
        after[1] = state[1] + sin * forward_mm + cos * left_mm + surroundings.carried_y_mm_s * dt_s
        after[2] = heading_rad + turn_rad
        return after

    def guess(self, command: np.ndarray) -> np.ndarray:
        """Expect speed in proportion to PWM, and a differential drive's motion (..., 3) over 0.5 s."""
        left_mm, right_mm = command[..., 0] * 0.35, command[..., 1] * 0.35
        turn_rad = (right_mm - left_mm) / 72.0
        forward_mm = (left_mm + right_mm) / 2
        return np.stack([forward_mm, forward_mm * turn_rad / 2, turn_rad], axis=-1)
