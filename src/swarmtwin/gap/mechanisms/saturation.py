"""Large commands are cut: a weak supply, a driver's current limit."""

from collections.abc import Mapping
from typing import ClassVar, Literal

from torch import Tensor

from swarmtwin.gap.mechanism import Drive, Mechanism, Quantity, change_effort, effort_limit, effort_unit
from swarmtwin.robot import Robot

STARTS = (0.3, 0.45, 0.6, 0.7, 0.8, 0.87, 0.93, 0.97)


class Config(Mechanism):
    """Efforts beyond `limit` act like it."""

    words: ClassVar = "commands beyond {limit} are cut"
    remedy: ClassVar = "check the supply and the driver's current limit, or keep commands below it"
    quantities: ClassVar = {"limit": Quantity(0.1, 1.0, 1.0, "", STARTS)}
    widening: ClassVar = 1.4

    name: Literal["saturation"] = "saturation"
    limit: float

    @classmethod
    def quantities_of(cls, robot: Robot) -> Mapping[str, Quantity]:
        """Give the limit in the command's unit."""
        high = effort_limit(robot)
        starts = tuple(share * high for share in STARTS)
        return {"limit": Quantity(0.1 * high, high, high, effort_unit(robot), starts, 0.01 * high)}

    def received(self, command: Tensor, drive: Drive) -> Tensor:
        """Cut."""
        return change_effort(command, drive, lambda effort: effort.clamp(-self.limit, self.limit))
