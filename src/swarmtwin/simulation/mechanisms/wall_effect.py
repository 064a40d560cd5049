"""Weaker near the walls: a worn edge of the table, water held back by the pool's sides."""

from collections.abc import Mapping
from typing import ClassVar, Literal

import torch
from torch import Tensor

from swarmtwin.robot import Robot
from swarmtwin.simulation.conditions import SessionConditions
from swarmtwin.simulation.local_traction import LocalTraction
from swarmtwin.simulation.mechanism import Moment, Parameter


class Config(LocalTraction):
    """The nearer the nearest wall, the less far actuators bring the vehicle: 1 − loss · exp(−distance / reach).

    Attributes:
        loss: share of the way, at the wall.
        reach_mm: distance over which it falls to a third.
    """

    words: ClassVar = "near the walls (within {reach_mm}) vehicles lose up to {loss} of their {slows:way/drive}"
    remedy: ClassVar = "keep away from the walls, or clean the table's edge"
    parameters: ClassVar = {}

    name: Literal["wall_effect"] = "wall_effect"
    loss: float
    reach_mm: float

    @classmethod
    def parameters_of(cls, robot: Robot, conditions: SessionConditions) -> Mapping[str, Parameter]:
        """Look for reaches up to half of the arena's smaller side."""
        least = float(min(conditions.arena_mm.high_mm - conditions.arena_mm.low_mm))
        reaches = tuple(reach * least for reach in (0.04, 0.1, 0.2))
        return {
            "loss": Parameter(-0.5, 1.0, 0.0, "", (0.2,), 0.01, doubted_ends="low"),
            "reach_mm": Parameter(0.01 * least, 0.5 * least, None, "mm", reaches, 0.005 * least),
        }

    def traction(self, position: Tensor, moment: Moment) -> Tensor:
        """Weaken the drive near the walls."""
        distance_mm = moment.conditions.wall_distance_mm(position)
        return 1.0 - self.loss * torch.exp(-distance_mm / self.reach_mm)
