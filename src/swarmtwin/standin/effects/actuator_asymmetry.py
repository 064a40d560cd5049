"""Left and right differ, or the fin's trim is off."""

from typing import Annotated, Self

import numpy as np
from pydantic import Field

from swarmtwin.robot import Robot
from swarmtwin.standin.effect import Effect, Placement, only_for


class ActuatorAsymmetry(Effect):
    """One wheel is faster than the other, or the fin stands askew.

    Attributes:
        ratio: for wheels: speed of the left one over that of the right one, their geometric mean unchanged;
            1.15 where none is given.
        angle_rad: for a fin: its angle when it is told to be straight; 0.15 where none is given.
    """

    ratio: Annotated[float, Field(ge=0.3, le=3)] | None = None
    angle_rad: Annotated[float, Field(ge=-0.7, le=0.7)] | None = None

    def on(self, robot: Robot, vehicle_count: int) -> Self:
        """Fill in the default of the robot's kind of actuator; refuse the other kind's parameter."""
        only_for("actuator_asymmetry", robot, ("ratio", self.ratio), ("angle_rad", self.angle_rad))
        if robot.actuation.kind == "thrust":
            return self.model_copy(update={"angle_rad": 0.15 if self.angle_rad is None else self.angle_rad})
        return self.model_copy(update={"ratio": 1.15 if self.ratio is None else self.ratio})

    def strength(self, placement: Placement) -> np.ndarray | float:
        """Make the left wheel faster by the square root of the ratio, the right one slower by as much."""
        if self.ratio is None:
            return 1.0
        root = self.ratio**0.5
        return np.array([root, 1 / root], placement.x_mm.dtype).reshape(2, 1, 1)

    def trim_rad(self) -> float:
        """Turn the fin."""
        return self.angle_rad or 0.0
