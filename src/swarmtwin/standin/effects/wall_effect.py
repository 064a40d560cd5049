"""Weaker near the walls: a worn edge of the table, water held back by the pool's sides."""

from typing import Annotated

import numpy as np
from pydantic import Field

from swarmtwin.robot import Arena
from swarmtwin.standin.effect import Effect, Placement, wall_distance_mm


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
        return 1.0 - self.loss * np.exp(wall_distance_mm(placement, arena) * (-1.0 / self.reach_mm))
