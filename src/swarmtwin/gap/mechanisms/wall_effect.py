"""Weaker near the walls: a worn edge of the table, water held back by the pool's sides."""

from collections.abc import Mapping
from typing import ClassVar, Literal

import torch
from torch import Tensor

from swarmtwin.gap.mechanism import Drive, Mechanism, Quantity
from swarmtwin.robot import Robot, SituationPart

REACHES = (0.04, 0.1, 0.2)


class Config(Mechanism):
    """The nearer the nearest wall, the less far actuators bring the vehicle: 1 − loss · exp(−distance / reach)."""

    words: ClassVar = "near the walls (within {reach_mm}) vehicles lose up to {loss} of their way"
    remedy: ClassVar = "keep away from the walls, or clean the table's edge"
    quantities: ClassVar = {}
    needs: ClassVar[tuple[SituationPart, ...]] = ("pose",)

    name: Literal["wall_effect"] = "wall_effect"
    loss: float
    reach_mm: float

    @classmethod
    def quantities_of(cls, robot: Robot) -> Mapping[str, Quantity]:
        """Look for reaches up to half of the arena's smaller side."""
        least = float(min(robot.arena_mm.high_mm - robot.arena_mm.low_mm))
        reaches = tuple(reach * least for reach in REACHES)
        return {
            "loss": Quantity(-0.5, 0.98, 0.0, "", (0.2,), 0.01),
            "reach_mm": Quantity(0.01 * least, 0.5 * least, None, "mm", reaches, 0.005 * least),
        }

    def grip(self, position: Tensor, drive: Drive) -> Tensor:
        """Weaken the drive near the walls."""
        distance_mm = drive.surroundings.wall_distance_mm(position)
        return 1.0 - self.loss * torch.exp(-distance_mm / self.reach_mm)
