"""Two wheels, each told its effort; a command is left, right."""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING

from swarmtwin.kinematics import Actuators, DrivenRobot, KinematicEquations, PhysicalParameter

if TYPE_CHECKING:
    from torch import Tensor

WHEELS = ("left", "right")


class Equations(KinematicEquations):
    """A wheel's speed is gain · effort · (1 + curvature · effort / limit), effort being what exceeds a dead band."""

    command_size = 2

    @classmethod
    def usual_actuators(cls, robot: DrivenRobot) -> Actuators:
        """Return two wheels, each driven by its column of the command."""
        return Actuators(kind="wheel", effort=robot.command_columns)

    def parameters(self, robot: DrivenRobot) -> Mapping[str, PhysicalParameter]:
        """Return the wheels' distance, and each wheel's gain, dead band and curvature."""
        limit = self._limit(robot)
        gain = PhysicalParameter(float(robot.displacement_limit[0]) / robot.period_s / limit)
        parameters = {"track_mm": PhysicalParameter(robot.vehicle_size_mm[1])}
        for wheel in WHEELS:
            parameters[f"{wheel}_gain_mm_s_per_unit"] = gain
            parameters[f"{wheel}_dead_band"] = PhysicalParameter(0.1 * limit)
            parameters[f"{wheel}_curvature"] = PhysicalParameter(0.5, signed=True)
        return parameters

    def velocities(
        self, command: Tensor, values: Mapping[str, Tensor], robot: DrivenRobot
    ) -> tuple[Tensor, Tensor, Tensor]:
        """Turn wheel speeds into forward speed and turn rate."""
        limit = self._limit(robot)
        left, right = (self._wheel_mm_s(wheel, command[:, i], values, limit) for i, wheel in enumerate(WHEELS))
        return (left + right) / 2, left.new_zeros(len(left)), (right - left) / values["track_mm"]

    def _wheel_mm_s(self, wheel: str, command: Tensor, values: Mapping[str, Tensor], limit: float) -> Tensor:
        effort = (command.abs() - values[f"{wheel}_dead_band"]).relu()
        bend = 1 + values[f"{wheel}_curvature"] * effort / limit
        return values[f"{wheel}_gain_mm_s_per_unit"] * command.sign() * effort * bend

    def _limit(self, robot: DrivenRobot) -> float:
        return float(robot.command_high.max())
