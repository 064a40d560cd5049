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

    Vehicles that attract each other do not change places: they meet, and then go on together. A neighbour whose way is
    not known stays, but for what it is pushed, as far as the vehicle and the other way.
    """

    stage: ClassVar = "body"
    words: ClassVar = (
        "vehicles {strength_mm_s:push each other apart/draw each other together} at {strength_mm_s} where they meet, "
        "and at 37 % of that {reach_mm} apart"
    )
    remedy: ClassVar = "keep the vehicles further apart, or look for wakes, magnets and cables"
    parameters: ClassVar = {}
    inputs: ClassVar[tuple[SituationPart, ...]] = ("pose", "neighbours")

    name: Literal["neighbour_interaction"] = "neighbour_interaction"
    strength_mm_s: float
    reach_mm: float

    @classmethod
    def parameters_of(cls, robot: Robot, conditions: SessionConditions) -> Mapping[str, Parameter]:
        """Look for reaches from half a vehicle to half an arena, and for up to four times the speed of full commands.

        That speed is what vehicles at the same place would push each other with, so that none is ever seen.
        """
        length = max(robot.vehicle_size_mm)
        least = float(min(conditions.arena_mm.high_mm - conditions.arena_mm.low_mm))
        high = 2 * robot.largest_displacement.forward_mm / robot.period_s
        return {
            "strength_mm_s": Parameter(-2 * high, 2 * high, 0.0, "mm/s", (0.1 * high,), 0.005 * high),
            "reach_mm": Parameter(0.4 * length, 0.5 * least, None, "mm", (0.8 * length, 2 * length), 0.01 * length),
        }

    def drift_velocity(self, displacement: Tensor, moment: Moment, steps: int = 8) -> Tensor:
        """Add what all neighbours do, in so many steps on the way of both."""
        own, start = 2 * displacement[:, None, :2], moment.neighbours[..., :2]
        duration_s = moment.duration_s[:, None, None]
        way = None if moment.neighbours_after is None else moment.neighbours_after[..., :2] - start
        pushed = last = torch.zeros_like(own)
        for step in range(steps):
            passed = (step + 0.5) / steps
            neighbours = start - pushed if way is None else start + passed * way
            apart = passed * own + pushed - neighbours
            distance_mm = apart.norm(dim=-1, keepdim=True) + 1e-3
            halfway_mm = (apart + (last if way is None else last / 2)).norm(dim=-1, keepdim=True)
            away_mm = self.strength_mm_s * torch.exp(-halfway_mm / self.reach_mm) * duration_s / steps
            pushes = torch.maximum(away_mm, -distance_mm / (2 if way is None else 1)) * apart / distance_mm
            last = pushes.nan_to_num(0.0).sum(dim=1, keepdim=True)
            pushed = pushed + last
        return rotate(pushed[:, 0] / moment.duration_s[:, None], moment.pose[:, 2])
