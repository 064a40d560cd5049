"""Two wheels whose speed goes with their effort."""

import torch

from swarmtwin.kinematics import KinematicEquations, PhysicalParameter
from swarmtwin.robot import Actuators


class Equations(KinematicEquations):
    """One gain for both wheels, and their distance."""

    command_size = 2

    @classmethod
    def usual_actuators(cls, robot):
        return Actuators(kind="wheel", effort=robot.command_columns, track_mm=80.0)

    def parameters(self, robot):
        return {"gain_mm_s_per_unit": PhysicalParameter(0.5), "track_mm": PhysicalParameter(60.0)}

    def velocities(self, command, values, robot):
        left, right = (values["gain_mm_s_per_unit"] * command).unbind(dim=-1)
        return (left + right) / 2, torch.zeros_like(left), (right - left) / values["track_mm"]
