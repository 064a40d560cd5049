"""One oscillating tail fin; a command is its mean angle in degrees, amplitude in degrees and frequency in rad/s."""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING

from swarmtwin.kinematics import Actuators, DrivenRobot, KinematicEquations, PhysicalParameter

if TYPE_CHECKING:
    from torch import Tensor


class Equations(KinematicEquations):
    """The fin pushes along its mean angle.

    Push, side force and turn each go with a power of amplitude · frequency, taken as 1 at both limits; without a beat
    the vehicle coasts.
    """

    command_size = 3

    @classmethod
    def usual_actuators(cls, robot: DrivenRobot) -> Actuators:
        """Return the fin: the second column, an amplitude, says how hard it works, the first one where it points."""
        return Actuators(kind="thrust", effort=robot.command_columns[1:2], steering=robot.command_columns[0])

    def parameters(self, robot: DrivenRobot) -> Mapping[str, PhysicalParameter]:
        """Return size and exponent of each velocity, and how the fin's angle acts."""
        forward_mm, left_mm, turn_rad = robot.displacement_limit.tolist()
        return {
            "push_mm_s": PhysicalParameter(0.5 * forward_mm / robot.period_s),
            "push_exponent": PhysicalParameter(1.5),
            "coasting_mm_s": PhysicalParameter(0.1 * forward_mm / robot.period_s),
            "side_mm_s": PhysicalParameter(0.3 * left_mm / robot.period_s, signed=True),
            "turn_rad_s": PhysicalParameter(0.3 * turn_rad / robot.period_s, signed=True),
            "turn_exponent": PhysicalParameter(1),
            "side_exponent": PhysicalParameter(1),
            "angle_gain": PhysicalParameter(1),
            "trim_deg": PhysicalParameter(5, signed=True),
        }

    def nominal_values(self, robot: DrivenRobot) -> Mapping[str, float]:
        """Let the strongest beat move and turn it as far as is believable, to the left at a positive mean angle."""
        forward_mm, _, turn_rad = robot.displacement_limit.tolist()
        strongest = {"push_mm_s": forward_mm / robot.period_s, "turn_rad_s": turn_rad / robot.period_s}
        return {**super().nominal_values(robot), **strongest}

    def velocities(
        self, command: Tensor, values: Mapping[str, Tensor], robot: DrivenRobot
    ) -> tuple[Tensor, Tensor, Tensor]:
        """Split the push by the angle at which it acts: trimmed, and larger than the fin's where the body gives way."""
        angle_rad = values["angle_gain"] * (command[:, 0] + values["trim_deg"]).deg2rad()
        strongest_beat = float(robot.command_high[1] * robot.command_high[2])
        beat = (command[:, 1] * command[:, 2] / strongest_beat).clamp(min=1e-6)  # 0 has no derivative of its power
        push, side, turn = (beat ** values[f"{name}_exponent"] for name in ("push", "side", "turn"))
        forward_mm_s = values["coasting_mm_s"] + values["push_mm_s"] * push * angle_rad.cos()
        left_mm_s = values["side_mm_s"] * side * angle_rad.sin()
        return forward_mm_s, left_mm_s, values["turn_rad_s"] * turn * angle_rad.sin()
