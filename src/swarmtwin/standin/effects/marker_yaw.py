"""The marker is turned on the vehicle."""

import math
from typing import Annotated

from pydantic import Field

from swarmtwin.standin.effect import Effect


class MarkerYaw(Effect):
    """The camera sees a heading that is off by a constant angle.

    Attributes:
        angle_rad: measured minus true heading.
    """

    angle_rad: Annotated[float, Field(ge=-math.pi, le=math.pi)] = 0.12

    def marker(self) -> tuple[float, float, float]:
        """Turn the marker on the vehicle."""
        return 0.0, 0.0, self.angle_rad
