"""A constant velocity in the arena's frame: a slope, a current."""

import math
from typing import Annotated

from pydantic import Field

from swarmtwin.standin.effect import Effect, Placement


class SteadyDrift(Effect):
    """Vehicles are carried along, whatever they do.

    Attributes:
        speed_mm_s: how fast.
        direction_rad: where to, in the arena's frame.
    """

    speed_mm_s: Annotated[float, Field(gt=0, le=100)] = 6.0
    direction_rad: Annotated[float, Field(ge=-2 * math.pi, le=2 * math.pi)] = 0.0

    def drift_velocity_mm_s(self, placement: Placement) -> tuple[float, float]:
        """Add the drift."""
        return self.speed_mm_s * math.cos(self.direction_rad), self.speed_mm_s * math.sin(self.direction_rad)
