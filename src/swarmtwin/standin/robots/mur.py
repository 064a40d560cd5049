"""The stand-in Micro-Underwater Robot: one tail fin on a servo, in a pool (paper, section 4.1.2)."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, ClassVar, Self

import numpy as np

from swarmtwin.standin.character import Character
from swarmtwin.standin.physics import Physics, Surroundings, Unit, fabricate, take_up


@dataclass(frozen=True)
class MurUnit(Unit):
    """What differs from unit to unit; each (V,).

    Attributes:
        spreads: standard deviation of each property's factor, of the trim in rad, in the order in which they are drawn.
        thrust: acceleration by the jet, mm/s² per (rad/s)² of squared beat.
        yaw: angular acceleration by a jet to the side, rad/s² per (rad/s)².
        drag_per_mm: quadratic drag along the body.
        servo_s: time constant of the servo.
        trim_rad: angle of the fin when it is told to be straight.
    """

    spreads: ClassVar[Mapping[str, float]] = {"thrust": 0.04, "yaw": 0.04, "drag": 0.03, "servo": 0.05, "trim": 0.02}

    thrust: np.ndarray
    yaw: np.ndarray
    drag_per_mm: np.ndarray
    servo_s: np.ndarray
    trim_rad: np.ndarray

    @classmethod
    def as_drawn(cls, vehicle_count: int = 1, dtype: Any = np.float64) -> Self:
        """Return units exactly as on the drawing."""
        one = np.ones(vehicle_count, dtype)
        return cls(one * 108.0, one * 3.6, one * 0.046, one * 0.04, one * 0.0)

    @classmethod
    def of(cls, vehicles: Sequence[str], dtype: Any = np.float64) -> Self:
        """Return the units with these ids."""
        drawn = cls.as_drawn(len(vehicles))
        factor = fabricate("mur", vehicles, cls.spreads)
        return cls(
            (drawn.thrust * factor["thrust"]).astype(dtype),
            (drawn.yaw * factor["yaw"]).astype(dtype),
            (drawn.drag_per_mm * factor["drag"]).astype(dtype),
            (drawn.servo_s * factor["servo"]).astype(dtype),
            (factor["trim"] - 1.0).astype(dtype),
        )


class StandIn(Physics):
    """Fin angle → thrust and yaw moment → motion through the water, at 0.02 s.

    The fin follows α(t) = mean + amplitude · sin(phase), phase' = frequency (the paper's α(t) = φ + ϕ sin(ωt)), the
    phase kept from command to command. Its beat about the mean, by its speed and by its bend alike, makes a jet that
    grows with the beat's square until the flow stalls, leaves the flexible fin at more than the fin's angle, and
    thrusts and turns the body. The body recoils from each stroke; a still fin steers like a rudder. Drag is quadratic
    ahead, nearly linear sideways (the body carries water along), and grows near the walls, which stop what touches.

    Attributes:
        setting_s: time constant with which the controller takes over a new mean, amplitude and frequency.
        servo_limit_rad_s: the servo's largest speed.
        deflection: the jet's angle over that of the fin.
        wag: how much the jet's angle follows the single stroke, rather than the mean angle.
        stall_beat: squared beat, (rad/s)², at which half of the thrust is lost.
        side_thrust: sideways over forward acceleration by the same jet.
        recoil: angular acceleration of the body against the fin's speed, per second.
        rudder_per_mm2: angular acceleration by the fin per squared speed ahead.
        linear_drag_per_s: ahead, sideways, turning.
        side_drag_per_mm: quadratic drag sideways.
        turn_drag_per_rad: quadratic drag of turning.
        eddies: random accelerations ahead and sideways, mm/s per √s, and of turning, rad/s per √s.
        wall_drag: share by which all drag grows for what touches a wall.
        wall_reach_mm: distance over which that falls to a third.
        clearance_mm: smallest distance between the vehicle's centre and a wall.
    """

    unit: MurUnit
    unit_class = MurUnit
    command_columns = ("mean_angle_deg", "amplitude_deg", "frequency_rad_s")
    states = (
        *("x_mm", "y_mm", "heading_rad", "ahead_mm_s", "left_mm_s", "turn_rad_s"),
        *("mean_rad", "amplitude_rad", "frequency_rad_s", "phase_rad", "servo_rad", "slack_rad"),
    )
    substeps = 40
    noises = 3
    position_noise_mm = 1.5
    heading_noise_rad = 0.015
    resting_command = (0.0, 0.0, 3.0)
    memory_of_place = True
    latent_draws = 128

    unruly = Character(
        motion_freedom=2.6,
        camera_freedom=4.0,
        noise_factor=1.8,
        marker_mm=(12.0, 0.0),
        marker_spread_mm=4.0,
        delay_s=0.03,
        loss_probability=0.004,
        jitter=0.01,
    )
    published = ((-67.0, 67.0, None), (0.0, 57.0, None), (3.0, 9.0, 9))

    setting_s = 0.06
    servo_limit_rad_s = 6.24
    deflection = 1.64
    wag = 0.05
    stall_beat = 11.7
    side_thrust = 1.5
    recoil = 0.084
    rudder_per_mm2 = 0.00012
    linear_drag_per_s = (0.8, 14.5, 11.6)
    side_drag_per_mm = 0.01
    turn_drag_per_rad = 2.58
    eddies = (26.0, 62.0, 1.4)
    wall_drag = 1.5
    wall_reach_mm = 60.0
    clearance_mm = 80.0

    def target(self, command: np.ndarray, strength: Any) -> np.ndarray:
        """Return the fin's (mean_rad, amplitude_rad, frequency_rad_s, strength) that a command asks for."""
        mean_rad, amplitude_rad = np.deg2rad(command[0]), np.deg2rad(command[1])
        return np.stack([mean_rad, amplitude_rad, command[2], np.broadcast_to(strength, mean_rad.shape)])

    def step(
        self,
        state: np.ndarray,
        target: np.ndarray,
        dt_s: Any,
        surroundings: Surroundings,
        noise: np.ndarray | None,
    ) -> np.ndarray:
        """Advance the fin, then the velocities, then the pose (semi-implicit Euler)."""
        after = state.copy()
        told_rad, fin_rad_s = self._move_fin(state, target, dt_s, after)
        beat_rad = (after[10] - after[6]) * self._share_of_stroke(after[7])
        beat_rad_s = fin_rad_s - (after[6] - state[6]) / dt_s
        beat = (beat_rad_s**2 + (after[8] * beat_rad) ** 2) * 0.5
        jet = (target[3] * surroundings.traction) ** 2 * beat / (1.0 + beat * (1.0 / self.stall_beat))
        fin_rad = told_rad + (self.unit.trim_rad + self.conditions.trim_rad)
        jet_rad = self.deflection * (fin_rad - (1.0 - self.wag) * beat_rad)
        self._accelerate(state, jet, jet_rad, beat_rad_s, dt_s, after)
        if noise is not None:
            kick = np.sqrt(dt_s) * self.conditions.noise_factor
            for index, size in enumerate(self.eddies):
                after[3 + index] += size * kick * noise[index]
        ahead, left, turn = after[3:6]
        middle_rad = state[2] + turn * (0.5 * dt_s)
        cos, sin = np.cos(middle_rad), np.sin(middle_rad)
        x_mm_s = cos * ahead - sin * left + surroundings.carried_x_mm_s
        y_mm_s = sin * ahead + cos * left + surroundings.carried_y_mm_s
        after[0], after[1] = state[0] + x_mm_s * dt_s, state[1] + y_mm_s * dt_s
        after[2] = state[2] + turn * dt_s
        self._stop_at_walls(after)
        return after

    def _share_of_stroke(self, amplitude_rad: np.ndarray) -> Any:
        """Return what the play of its gear leaves of the fin's amplitude: none of one that is less than half of it."""
        if not self.conditions.backlash:
            return 1.0
        lost = 0.5 * self.conditions.backlash / np.maximum(amplitude_rad, 1e-9)
        return np.maximum(1.0 - lost, 0.0)

    def _move_fin(
        self, state: np.ndarray, target: np.ndarray, dt_s: Any, after: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray]:
        """Return the fin's angle behind the play of its gear, rad, but for its trim, and its rate, rad/s."""
        settling = 1.0 - np.exp(-dt_s / (self.setting_s + self.conditions.lag_s))
        after[6:9] = state[6:9] + (target[:3] - state[6:9]) * settling
        phase_rad = state[9] + after[8] * dt_s
        after[9] = phase_rad - (phase_rad > np.pi) * (2 * np.pi)
        wanted_rad = after[6] + after[7] * np.sin(after[9])
        largest_rad = self.servo_limit_rad_s * dt_s
        stroke_rad = (wanted_rad - state[10]) * (1.0 - np.exp(-dt_s / self.unit.servo_s))
        stroke_rad = np.clip(stroke_rad, -largest_rad, largest_rad)
        after[10], after[11] = state[10] + stroke_rad, state[11]
        fin_rad = after[10]
        if self.conditions.backlash:
            after[11], stroke_rad = take_up(state[11], stroke_rad, self.conditions.backlash)
            fin_rad = fin_rad - after[11] + 0.5 * self.conditions.backlash
        return fin_rad, stroke_rad / dt_s

    def _accelerate(
        self,
        state: np.ndarray,
        jet: np.ndarray,
        jet_rad: np.ndarray,
        beat_rad_s: np.ndarray,
        dt_s: Any,
        after: np.ndarray,
    ) -> None:
        ahead, left, turn = state[3:6]
        cos, sin = np.cos(jet_rad), np.sin(jet_rad)
        water = self._near_walls(state)
        slow, side, spin = self.linear_drag_per_s
        thrust = self.unit.thrust * jet
        moment = (
            self.unit.yaw * jet * sin + self.rudder_per_mm2 * ahead * np.abs(ahead) * sin - self.recoil * beat_rad_s
        )
        drag_ahead = (slow + self.unit.drag_per_mm * np.abs(ahead)) * water
        drag_left = (side + self.side_drag_per_mm * np.abs(left)) * water
        drag_turn = (spin + self.turn_drag_per_rad * np.abs(turn)) * water
        after[3] = (ahead + dt_s * (thrust * cos + turn * left)) / (1.0 + dt_s * drag_ahead)
        after[4] = (left - dt_s * (self.side_thrust * thrust * sin + turn * ahead)) / (1.0 + dt_s * drag_left)
        after[5] = (turn + dt_s * moment) / (1.0 + dt_s * drag_turn)

    def _near_walls(self, state: np.ndarray) -> np.ndarray:
        arena = self.conditions.robot.arena_mm
        from_x = np.minimum(state[0] - arena.x[0], arena.x[1] - state[0])
        from_y = np.minimum(state[1] - arena.y[0], arena.y[1] - state[1])
        distance_mm = np.minimum(from_x, from_y) - self.clearance_mm
        return 1.0 + self.wall_drag * np.exp(distance_mm * (-1.0 / self.wall_reach_mm))

    def _stop_at_walls(self, after: np.ndarray) -> None:
        """Keep the vehicles in the pool: what goes into a wall loses its velocity across it."""
        arena = self.conditions.robot.arena_mm
        beyond_x = after[0] - np.clip(after[0], arena.x[0] + self.clearance_mm, arena.x[1] - self.clearance_mm)
        beyond_y = after[1] - np.clip(after[1], arena.y[0] + self.clearance_mm, arena.y[1] - self.clearance_mm)
        if not (beyond_x.any() or beyond_y.any()):
            return
        cos, sin = np.cos(after[2]), np.sin(after[2])
        x_mm_s = np.where(beyond_x == 0.0, cos * after[3] - sin * after[4], 0.0)
        y_mm_s = np.where(beyond_y == 0.0, sin * after[3] + cos * after[4], 0.0)
        touching = (beyond_x != 0.0) | (beyond_y != 0.0)
        after[3] = np.where(touching, cos * x_mm_s + sin * y_mm_s, after[3])
        after[4] = np.where(touching, cos * y_mm_s - sin * x_mm_s, after[4])
        after[0] -= beyond_x
        after[1] -= beyond_y

    def guess(self, command: np.ndarray) -> np.ndarray:
        """Expect speed to grow with the fin's, and turning with its mean angle (..., 3), over 0.8 s."""
        jet_rad = self.deflection * np.deg2rad(command[..., 0])
        beat_rad_s = np.minimum(np.deg2rad(command[..., 1]) * command[..., 2], self.servo_limit_rad_s)
        forward_mm = 15.0 * beat_rad_s * np.cos(jet_rad)
        turn_rad = 0.25 * beat_rad_s * np.sin(jet_rad)
        return np.stack([forward_mm, forward_mm * turn_rad / 2, turn_rad], axis=-1)
