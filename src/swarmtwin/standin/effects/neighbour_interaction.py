"""Vehicles push or drag each other at a distance: wakes, magnets, cables."""

from typing import Annotated, Self

import numpy as np
from pydantic import Field

from swarmtwin.errors import UserError
from swarmtwin.robot import Robot
from swarmtwin.standin.effect import Effect, Placement


class NeighbourInteraction(Effect):
    """Each neighbour adds a velocity away from it: strength · exp(−distance / reach).

    Attributes:
        strength_mm_s: the velocity where they would meet; negative where they attract each other.
        reach_mm: distance over which it falls to a third.
    """

    strength_mm_s: Annotated[float, Field(ge=-200, le=200)] = 30.0
    reach_mm: Annotated[float, Field(gt=0)] = 150.0

    def on(self, robot: Robot, vehicle_count: int) -> Self:
        """Refuse a vehicle alone."""
        if vehicle_count < 2:
            raise UserError("effect 'neighbour_interaction' needs neighbours: give two vehicles or more, vehicle=[1,2]")
        return self

    def drift_velocity_mm_s(self, placement: Placement) -> tuple[np.ndarray, np.ndarray]:
        """Add what all neighbours do."""
        away_x, away_y = placement.x_mm - placement.neighbour_x_mm, placement.y_mm - placement.neighbour_y_mm
        distance_mm = np.hypot(away_x, away_y) + 1e-3
        push = self.strength_mm_s * np.exp(distance_mm * (-1.0 / self.reach_mm)) / distance_mm
        return (push * away_x).sum(axis=0), (push * away_y).sum(axis=0)
