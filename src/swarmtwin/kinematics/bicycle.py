"""A car: one throttle, and front wheels that a servo steers; a command is throttle, steering in degrees to the left."""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING

from swarmtwin.kinematics import Actuators, Before, DrivenRobot, KinematicEquations, PhysicalParameter

if TYPE_CHECKING:
    from torch import Tensor


class Equations(KinematicEquations):
    """The bicycle model: κ = tan(δ) / wheelbase is the curvature of the rear axle's path, whatever the speed.

    The throttle asks for the speed gain · effort · (1 + curvature · effort / limit), effort being what exceeds a dead
    band; δ = gain · (steering + trim). The marker stands some way ahead of the rear axle, and swings to the side there.

    With momentum, the speed v relaxes to the one asked for, u, with a time constant τ: v(t) = u + (v₀ − u) e^(−t/τ). As
    the curvature is constant over a period, so is the direction of the twist, and the mean speed leads to the same end.
    A measured velocity is the mean of the period before; where that began and ended follows from its command.
    """

    command_size = 2

    @classmethod
    def usual_actuators(cls, robot: DrivenRobot) -> Actuators:
        """Return wheels: the first column is the throttle of all, the second steers."""
        throttle, steering = robot.command_columns
        return Actuators(kind="wheel", effort=(throttle,), steering=steering)

    def parameters(self, robot: DrivenRobot) -> Mapping[str, PhysicalParameter]:
        """Return the car's lengths, the throttle's gain, dead band and curvature, and the steering's gain and trim."""
        length_mm, limit = robot.vehicle_size_mm[0], self._limit(robot)
        return {
            "wheelbase_mm": PhysicalParameter(0.6 * length_mm),
            "marker_ahead_mm": PhysicalParameter(0.3 * length_mm, signed=True),
            "speed_gain_mm_s_per_unit": PhysicalParameter(float(robot.displacement_limit[0]) / robot.period_s / limit),
            "dead_band": PhysicalParameter(0.1 * limit),
            "curvature": PhysicalParameter(0.5, signed=True),
            "steering_gain": PhysicalParameter(1),
            "trim_deg": PhysicalParameter(5, signed=True),
        }

    def momentum_parameters(self, robot: DrivenRobot) -> Mapping[str, PhysicalParameter]:
        """Return the time constant of the speed."""
        return {"time_constant_s": PhysicalParameter(5 * robot.period_s)}

    def velocities(
        self, command: Tensor, values: Mapping[str, Tensor], robot: DrivenRobot
    ) -> tuple[Tensor, Tensor, Tensor]:
        """Drive at the speed that the throttle asks for."""
        return self._steered(self._asked_mm_s(command, values, robot), command, values)

    def velocities_after(
        self, before: Before, command: Tensor, values: Mapping[str, Tensor], robot: DrivenRobot
    ) -> tuple[Tensor, Tensor, Tensor]:
        """Let the speed relax to what the throttle asks for, from that at the end of the period before."""
        periods = robot.period_s / values["time_constant_s"]
        left_over = (-periods).exp()
        mean_left_over = -(-periods).expm1() / periods
        asked_before, asked = (self._asked_mm_s(told, values, robot) for told in (before.command, command))
        at_start = asked_before + (before.velocity[:, 0] - asked_before) * left_over / mean_left_over
        return self._steered(asked + (at_start - asked) * mean_left_over, command, values)

    def _asked_mm_s(self, command: Tensor, values: Mapping[str, Tensor], robot: DrivenRobot) -> Tensor:
        throttle = command[:, 0]
        effort = (throttle.abs() - values["dead_band"]).relu()
        bend = 1 + values["curvature"] * effort / self._limit(robot)
        return values["speed_gain_mm_s_per_unit"] * throttle.sign() * effort * bend

    def _steered(
        self, forward_mm_s: Tensor, command: Tensor, values: Mapping[str, Tensor]
    ) -> tuple[Tensor, Tensor, Tensor]:
        angle_rad = (values["steering_gain"] * (command[:, 1] + values["trim_deg"])).deg2rad()
        turn_rad_s = forward_mm_s * angle_rad.tan() / values["wheelbase_mm"]
        return forward_mm_s, values["marker_ahead_mm"] * turn_rad_s, turn_rad_s

    def _limit(self, robot: DrivenRobot) -> float:
        return float(robot.command_high[0])
