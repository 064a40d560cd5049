"""Small commands do nothing: stiction, a cheap motor driver."""

from collections.abc import Mapping
from typing import ClassVar, Literal

import torch
from torch import Tensor

from swarmtwin.gap.mechanism import Drive, Mechanism, Quantity, change_effort, effort_limit, effort_unit
from swarmtwin.robot import Robot

STARTS = 24


class Config(Mechanism):
    """Efforts smaller than `width` do nothing, larger ones act as ever."""

    words: ClassVar = "commands below {width} do nothing"
    remedy: ClassVar = "raise small commands above the dead-band, or exchange the driver or motor"
    quantities: ClassVar = {"width": Quantity(0.0, 1.0, 0.0, "", (0.2,))}
    is_smooth: ClassVar = False

    name: Literal["dead_band"] = "dead_band"
    width: float

    @classmethod
    def quantities_of(cls, robot: Robot) -> Mapping[str, Quantity]:
        """Give the width in the command's unit."""
        high = 0.7 * effort_limit(robot)
        starts = tuple(high * (index + 0.5) / STARTS for index in range(STARTS))
        return {"width": Quantity(0.0, high, 0.0, effort_unit(robot), starts, high / (2 * STARTS))}

    def received(self, command: Tensor, drive: Drive) -> Tensor:
        """Leave out what is smaller than the width."""
        return change_effort(
            command, drive, lambda effort: torch.where(effort.abs() < self.width, torch.zeros_like(effort), effort)
        )
