"""Left and right differ, or the fin's trim is off."""

import math
from collections.abc import Mapping
from typing import ClassVar, Literal

import torch
from torch import Tensor

from swarmtwin.gap.mechanism import Drive, Mechanism, Quantity
from swarmtwin.gap.surroundings import Surroundings
from swarmtwin.robot import Robot

RATIO = Quantity(0.3, 3.0, 1.0, "", (1.0,))
ANGLE = Quantity(-0.7, 0.7, 0.0, "rad", (0.0,), 0.01)


class Config(Mechanism):
    """The left wheel is faster than the right one by `ratio`, their geometric mean unchanged; or a fin is askew.

    Attributes:
        ratio: of wheels.
        angle_rad: of what is steered by an angle.
    """

    words: ClassVar = "left and right differ: {ratio}{angle_rad}"
    remedy: ClassVar = "compare the wheels or motors, or trim the fin"
    quantities: ClassVar = {"ratio": RATIO, "angle_rad": ANGLE}

    name: Literal["actuator_asymmetry"] = "actuator_asymmetry"
    ratio: float | None = None
    angle_rad: float | None = None

    @classmethod
    def suits(cls, robot: Robot, surroundings: Surroundings) -> bool:
        """Wheels need a track, thrust a steering angle."""
        return bool(cls.quantities_of(robot)) and (robot.actuation.kind == "thrust" or bool(surroundings.track_mm))

    @classmethod
    def quantities_of(cls, robot: Robot) -> Mapping[str, Quantity]:
        """Ask wheels for a ratio, steered thrust for an angle."""
        if robot.actuation.kind == "wheel":
            return {"ratio": RATIO}
        return {"angle_rad": ANGLE} if robot.actuation.steering else {}

    def received(self, command: Tensor, drive: Drive) -> Tensor:
        """Turn the fin."""
        steering = drive.robot.actuation.steering
        if self.angle_rad is None or steering is None:
            return command
        changed = command.clone()
        changed[:, drive.robot.command_columns.index(steering)] += math.degrees(self.angle_rad)
        return changed

    def strength(self, drive: Drive) -> Tensor:
        """Make one wheel faster, the other slower."""
        if self.ratio is None:
            return torch.ones(1, 1, dtype=torch.float64)
        return torch.tensor([[self.ratio**0.5, self.ratio**-0.5]], dtype=torch.float64)
