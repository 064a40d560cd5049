"""Large commands are cut: a weak supply, a driver's current limit."""

from typing import Annotated, Self

import numpy as np
from pydantic import Field

from swarmtwin.errors import UserError
from swarmtwin.robot import Robot
from swarmtwin.standin.effect import Effect, change_thrust, thrust_limit


class Saturation(Effect):
    """Commands beyond a limit act like the limit, smaller ones as ever.

    Attributes:
        limit: PWM of a wheel, or degrees of the fin's amplitude; 0.6 of the largest command where none is given.
    """

    limit: Annotated[float, Field(gt=0)] | None = None

    def on(self, robot: Robot, vehicle_count: int) -> Self:
        """Fill in the default for the robot's commands; refuse a limit that cuts none of them."""
        largest = thrust_limit(robot)
        if self.limit is not None and self.limit >= largest:
            raise UserError(
                f"effect 'saturation': limit {self.limit:g} cuts no command of {robot.name!r}: "
                f"give less than {largest:g}"
            )
        return self.model_copy(update={"limit": 0.6 * largest if self.limit is None else self.limit})

    def transform_command(self, command: np.ndarray, robot: Robot) -> np.ndarray:
        """Cut what is larger than the limit."""
        limit = self.limit or thrust_limit(robot)
        return change_thrust(command, robot, lambda thrust: np.clip(thrust, -limit, limit))
