"""Large commands are cut: a weak supply, a driver's current limit."""

from collections.abc import Mapping
from typing import ClassVar, Literal

from torch import Tensor

from swarmtwin.robot import Robot
from swarmtwin.simulation.conditions import SessionConditions
from swarmtwin.simulation.efforts import change_effort, effort_limit, effort_unit
from swarmtwin.simulation.mechanism import Mechanism, Moment, Parameter


class Config(Mechanism):
    """Efforts beyond `limit` act like it."""

    stage: ClassVar = "controller"
    words: ClassVar = "commands beyond {limit} are cut"
    remedy: ClassVar = "check the supply and the driver's current limit, or keep commands below it"
    parameters: ClassVar = {"limit": Parameter(0.1, 1.0, 1.0, "", (0.5,))}

    name: Literal["saturation"] = "saturation"
    limit: float

    @classmethod
    def suits(cls, robot: Robot, conditions: SessionConditions) -> bool:
        """Know which columns are efforts."""
        return robot.actuation.kind == "wheel" or bool(robot.actuation.effort)

    @classmethod
    def parameters_of(cls, robot: Robot, conditions: SessionConditions) -> Mapping[str, Parameter]:
        """Give the limit in the command's unit."""
        high = effort_limit(robot)
        grid = tuple(share * high for share in (0.3, 0.45, 0.6, 0.7, 0.8, 0.87, 0.93, 0.97))
        return {"limit": Parameter(0.1 * high, high, high, effort_unit(robot), grid, 0.01 * high)}

    def transform_command(self, command: Tensor, moment: Moment) -> Tensor:
        """Cut efforts to the limit."""
        return change_effort(command, moment, lambda effort: effort.clamp(-self.limit, self.limit))
