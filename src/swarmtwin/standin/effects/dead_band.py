"""Small commands do nothing: stiction, a cheap motor driver."""

from typing import Annotated, Self

import numpy as np
from pydantic import Field

from swarmtwin.errors import UserError
from swarmtwin.robot import Robot
from swarmtwin.standin.effect import Effect, change_thrust, thrust_limit


class DeadBand(Effect):
    """Commands smaller than a width do nothing, larger ones act as ever.

    Attributes:
        width: PWM of a wheel, or degrees of the fin's amplitude; a quarter of the largest command where none is given.
    """

    width: Annotated[float, Field(gt=0)] | None = None

    def on(self, robot: Robot, vehicle_count: int) -> Self:
        """Fill in the default for the robot's commands; refuse a width that leaves none of them."""
        limit = thrust_limit(robot)
        if self.width is not None and self.width >= limit:
            raise UserError(
                f"effect 'dead_band': width {self.width:g} leaves {robot.name!r} no command that does anything: "
                f"give less than {limit:g}"
            )
        return self.model_copy(update={"width": 0.25 * limit if self.width is None else self.width})

    def transform_command(self, command: np.ndarray, robot: Robot) -> np.ndarray:
        """Leave out what is smaller than the width."""
        return change_thrust(command, robot, lambda thrust: np.where(np.abs(thrust) < self.width, 0.0, thrust))
