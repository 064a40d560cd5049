"""Another traction in a region of the arena: dust or oil on the ground, weeds in the water."""

from typing import Annotated, Self

import numpy as np
from pydantic import Field

from swarmtwin.errors import UserError
from swarmtwin.robot import Arena, Robot
from swarmtwin.standin.effect import Effect, Placement


class SurfacePatch(Effect):
    """On a disc, the same drive gets the vehicle less far.

    Attributes:
        x_mm: the disc's centre; the arena's where none is given.
        y_mm: the disc's centre; the arena's where none is given.
        radius_mm: the disc's radius.
        loss: share of the way that is lost there; negative where the traction is better.
    """

    x_mm: float | None = None
    y_mm: float | None = None
    radius_mm: Annotated[float, Field(gt=0)] = 250.0
    loss: Annotated[float, Field(ge=-0.5, lt=1)] = 0.4

    def on(self, robot: Robot, vehicle_count: int) -> Self:
        """Put the disc in the middle if it has no place; refuse one that does not touch the arena."""
        low, high = robot.arena_mm.low_mm, robot.arena_mm.high_mm
        middle = ((low + high) / 2).tolist()
        centre = [
            given if given is not None else half for given, half in zip((self.x_mm, self.y_mm), middle, strict=True)
        ]
        if np.linalg.norm(centre - np.clip(centre, low, high)) >= self.radius_mm:
            raise UserError(
                f"effect 'surface_patch': the disc around x_mm {centre[0]:g}, y_mm {centre[1]:g} lies outside the "
                f"arena: x {list(robot.arena_mm.x)}, y {list(robot.arena_mm.y)}"
            )
        return self.model_copy(update={"x_mm": centre[0], "y_mm": centre[1]})

    def traction(self, placement: Placement, arena: Arena) -> np.ndarray:
        """Weaken the drive inside the disc."""
        away_mm = np.hypot(placement.x_mm - self.x_mm, placement.y_mm - self.y_mm)
        return 1.0 - self.loss * (away_mm < self.radius_mm).astype(away_mm.dtype)
