"""Vehicles push or drag each other at a distance: wakes, magnets, cables."""

from collections.abc import Mapping
from typing import ClassVar, Literal

import torch
from torch import Tensor

from swarmtwin.geometry import rotate
from swarmtwin.robot import Robot, SituationPart
from swarmtwin.simulation.conditions import SessionConditions
from swarmtwin.simulation.mechanism import Mechanism, Moment, Parameter


class Config(Mechanism):
    """Each neighbour adds a velocity away from it: strength · exp(−distance / reach); negative attracts.

    Vehicles that attract each other do not change places: in a period each comes half of the way between them at most.
    Distances are those in the middle of the vehicle's own way; where the neighbour goes meanwhile is not known.
    """

    stage: ClassVar = "body"
    words: ClassVar = "vehicles push each other apart at {strength_mm_s} where they meet, falling over {reach_mm}"
    remedy: ClassVar = "keep the vehicles further apart, or look for wakes, magnets and cables"
    parameters: ClassVar = {}
    inputs: ClassVar[tuple[SituationPart, ...]] = ("pose", "neighbours")

    name: Literal["neighbour_interaction"] = "neighbour_interaction"
    strength_mm_s: float
    reach_mm: float

    @classmethod
    def parameters_of(cls, robot: Robot, conditions: SessionConditions) -> Mapping[str, Parameter]:
        """Look for reaches from half a vehicle to half an arena."""
        length = max(robot.vehicle_size_mm)
        least = float(min(conditions.arena_mm.high_mm - conditions.arena_mm.low_mm))
        high = 2 * robot.largest_displacement.forward_mm / robot.period_s
        return {
            "strength_mm_s": Parameter(-high, high, 0.0, "mm/s", (0.1 * high,), 0.005 * high),
            "reach_mm": Parameter(0.4 * length, 0.5 * least, None, "mm", (0.8 * length, 2 * length), 0.01 * length),
        }

    def drift_velocity(self, displacement: Tensor, moment: Moment) -> Tensor:
        """Add what all neighbours do."""
        apart = displacement[:, None, :2] - moment.neighbours[..., :2]
        distance_mm = apart.norm(dim=-1, keepdim=True) + 1e-3
        speed_mm_s = self.strength_mm_s * torch.exp(-distance_mm / self.reach_mm)
        met_mm_s = -distance_mm / (2 * moment.duration_s[:, None, None])
        push = torch.maximum(speed_mm_s, met_mm_s) * apart / distance_mm
        return rotate(push.nan_to_num(0.0).sum(dim=1), moment.pose[:, 2])
