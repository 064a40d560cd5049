"""A vehicle that is told its motion; a command is a forward speed in mm/s and a turn rate in rad/s."""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING

from swarmtwin.kinematics import Actuators, DrivenRobot, KinematicEquations, PhysicalParameter

if TYPE_CHECKING:
    from torch import Tensor


class Equations(KinematicEquations):
    """Forward speed and turn rate as commanded, up to a gain each, and a veer: a turn with every millimetre driven."""

    command_size = 2

    @classmethod
    def usual_actuators(cls, robot: DrivenRobot) -> Actuators:
        """Return two wheels, as far apart as the vehicle is wide, that no column of the command names."""
        return Actuators(kind="wheel", track_mm=robot.vehicle_size_mm[1])

    def parameters(self, robot: DrivenRobot) -> Mapping[str, PhysicalParameter]:
        """Return both gains and the veer."""
        return {
            "speed_gain": PhysicalParameter(1),
            "turn_gain": PhysicalParameter(1),
            "veer_rad_per_mm": PhysicalParameter(1e-3, signed=True),
        }

    def velocities(
        self, command: Tensor, values: Mapping[str, Tensor], robot: DrivenRobot
    ) -> tuple[Tensor, Tensor, Tensor]:
        """Scale the command."""
        forward_mm_s = values["speed_gain"] * command[:, 0]
        turn_rad_s = values["turn_gain"] * command[:, 1] + values["veer_rad_per_mm"] * forward_mm_s
        return forward_mm_s, forward_mm_s.new_zeros(len(forward_mm_s)), turn_rad_s
