"""Weaker near the walls: a worn edge of the table, water held back by the pool's sides."""

from typing import Annotated

import numpy as np
from pydantic import Field

from swarmtwin.robot import Arena
from swarmtwin.standin.effect import Effect, Placement


class WallEffect(Effect):
    """The nearer the nearest wall, the less far the same drive gets the vehicle: 1 − loss · exp(−distance / reach).

    Attributes:
        loss: share of the way that is lost at the wall itself.
        reach_mm: distance over which the loss falls to a third.
    """

    loss: Annotated[float, Field(gt=0, lt=1)] = 0.5
    reach_mm: Annotated[float, Field(gt=0)] = 150.0

    def traction(self, placement: Placement, arena: Arena) -> np.ndarray:
        """Weaken the drive near the walls."""
        from_x = np.minimum(placement.x_mm - arena.x[0], arena.x[1] - placement.x_mm)
        from_y = np.minimum(placement.y_mm - arena.y[0], arena.y[1] - placement.y_mm)
        distance_mm = np.maximum(np.minimum(from_x, from_y), 0.0)
        return 1.0 - self.loss * np.exp(distance_mm * (-1.0 / self.reach_mm))
