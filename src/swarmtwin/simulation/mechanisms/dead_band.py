"""Small commands do nothing: stiction, a cheap motor driver."""

from collections.abc import Mapping
from typing import ClassVar, Literal

import torch
from torch import Tensor
from torch.nn.functional import softshrink

from swarmtwin.robot import Robot
from swarmtwin.simulation.conditions import SessionConditions
from swarmtwin.simulation.efforts import change_effort, effort_limit, effort_unit
from swarmtwin.simulation.mechanism import Mechanism, Moment, Parameter


class Config(Mechanism):
    """Efforts smaller than `width` do nothing; larger ones act as ever, or as if they were smaller by as much.

    A driver that does not start below a threshold is of the first form, friction that takes its part of every effort
    of the second.

    Attributes:
        width: of the band, in the command's unit.
        larger: what larger efforts do.
    """

    stage: ClassVar = "controller"
    words: ClassVar = "commands below {width} do nothing, and larger ones {larger:all that they should/as much less}"
    remedy: ClassVar = "raise small commands above the dead-band, or exchange the driver or motor"
    parameters: ClassVar = {"width": Parameter(0.0, 1.0, 0.0, "", (0.2,))}
    is_smooth: ClassVar = False

    name: Literal["dead_band"] = "dead_band"
    width: float
    larger: Literal["whole", "less"] = "whole"

    @classmethod
    def forms(cls, robot: Robot) -> tuple[type[Mechanism], ...]:
        """Return that of a threshold and that of friction."""
        return Config, Config.with_default("larger", "less")

    @classmethod
    def suits(cls, robot: Robot, conditions: SessionConditions) -> bool:
        """Know which columns are efforts."""
        return robot.actuation.kind == "wheel" or bool(robot.actuation.effort)

    @classmethod
    def parameters_of(cls, robot: Robot, conditions: SessionConditions) -> Mapping[str, Parameter]:
        """Give the width in the command's unit."""
        limit, count = effort_limit(robot), 32
        high = 0.95 * limit
        grid = tuple(high * (index + 0.5) / count for index in range(count))
        return {"width": Parameter(0.0, high, 0.0, effort_unit(robot), grid, limit / 70)}

    def transform_command(self, command: Tensor, moment: Moment) -> Tensor:
        """Leave out what is smaller than the width, or the width."""
        if self.larger == "less":
            return change_effort(command, moment, lambda effort: softshrink(effort, self.width))
        return change_effort(
            command, moment, lambda effort: torch.where(effort.abs() < self.width, torch.zeros_like(effort), effort)
        )
