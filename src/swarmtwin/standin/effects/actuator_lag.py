"""Speed follows the command gradually: tired motors, a slow fin controller."""

from typing import Annotated

from pydantic import Field

from swarmtwin.standin.effect import Effect


class ActuatorLag(Effect):
    """The time constant of the motors, or of the fin's setting, is longer than when the robot was new.

    Attributes:
        time_constant_s: what is added to it.
    """

    time_constant_s: Annotated[float, Field(gt=0, le=1)] = 0.1

    def lag_s(self) -> float:
        """Add to the actuators' time constant."""
        return self.time_constant_s
