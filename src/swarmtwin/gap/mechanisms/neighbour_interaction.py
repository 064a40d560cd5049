"""Vehicles push or drag each other at a distance: wakes, magnets, cables."""

from collections.abc import Mapping
from typing import ClassVar, Literal

import torch
from torch import Tensor

from swarmtwin.dynamics.twist import displacement_of
from swarmtwin.gap.mechanism import Drive, Mechanism, Quantity
from swarmtwin.geometry import rotate
from swarmtwin.robot import Robot, SituationPart


class Config(Mechanism):
    """Each neighbour adds a velocity away from it: strength · exp(−distance / reach); negative attracts.

    Distances are those in the middle of the vehicle's own way; where the neighbour goes meanwhile is not known.
    """

    words: ClassVar = "vehicles push each other apart at {strength_mm_s} where they meet, falling over {reach_mm}"
    remedy: ClassVar = "keep the vehicles further apart, or look for wakes, magnets and cables"
    quantities: ClassVar = {}
    needs: ClassVar[tuple[SituationPart, ...]] = ("pose", "neighbours")
    widening: ClassVar = 1.4

    name: Literal["neighbour_interaction"] = "neighbour_interaction"
    strength_mm_s: float
    reach_mm: float

    @classmethod
    def quantities_of(cls, robot: Robot) -> Mapping[str, Quantity]:
        """Look for reaches from half a vehicle to half an arena."""
        length = max(robot.vehicle_size_mm)
        least = float(min(robot.arena_mm.high_mm - robot.arena_mm.low_mm))
        high = 2 * robot.largest_displacement.forward_mm / robot.period_s
        return {
            "strength_mm_s": Quantity(-high, high, 0.0, "mm/s", (0.1 * high,), 0.005 * high),
            "reach_mm": Quantity(0.4 * length, 0.5 * least, None, "mm", (0.8 * length, 2 * length), 0.01 * length),
        }

    def carried_mm_s(self, way: Tensor, drive: Drive) -> Tensor:
        """Add what all neighbours do."""
        middle = displacement_of(way / 2)[:, None, :2]
        apart = middle - drive.neighbours[..., :2]
        distance_mm = apart.norm(dim=-1, keepdim=True) + 1e-3
        push = self.strength_mm_s * torch.exp(-distance_mm / self.reach_mm) * apart / distance_mm
        return rotate(push.nan_to_num(0.0).sum(dim=1), drive.pose[:, 2])
