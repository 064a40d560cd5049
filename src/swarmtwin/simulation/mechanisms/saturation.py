"""Large commands are cut: a weak supply, a driver's current limit."""

from collections.abc import Mapping
from functools import lru_cache
from typing import ClassVar, Literal

import numpy as np
import torch
from scipy.optimize import brentq
from torch import Tensor

from swarmtwin.robot import Robot
from swarmtwin.simulation.conditions import SessionConditions
from swarmtwin.simulation.efforts import change_effort, effort_limit, effort_unit
from swarmtwin.simulation.mechanism import Mechanism, Moment, Parameter


@lru_cache(maxsize=1000)
def _bend(share: float) -> float:
    """Return x at which tanh(x) is such a share of x; 0 for all of it."""
    if share > 1 - 1e-6:
        return 0.0
    return float(brentq(lambda x: np.tanh(x) / x - share, 1e-4, 1 / share))


class Config(Mechanism):
    """Efforts beyond `limit` act like it; or all act gradually less, by a hyperbolic tangent, the largest like `limit`.

    Attributes:
        limit: like which the largest effort acts, in the command's unit.
        sets_in: which of the two.
    """

    stage: ClassVar = "controller"
    words: ClassVar = (
        "{sets_in:commands beyond/large commands do gradually less, and the largest does what} {limit} "
        "{sets_in:are cut/should}"
    )
    remedy: ClassVar = "check the supply and the driver's current limit, or keep commands below it"
    parameters: ClassVar = {"limit": Parameter(0.1, 1.0, 1.0, "", (0.5,))}

    name: Literal["saturation"] = "saturation"
    limit: float
    sets_in: Literal["sharply", "gradually"] = "sharply"

    @classmethod
    def forms(cls, robot: Robot) -> tuple[type[Mechanism], ...]:
        """Return that of a sharp limit and the gradual one."""
        return Config, Config.with_default("sets_in", "gradually")

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
        """Cut efforts to the limit, or bend them."""
        if self.sets_in == "gradually":
            bend = _bend(self.limit / effort_limit(moment.robot)) / effort_limit(moment.robot)
            return change_effort(command, moment, lambda effort: torch.tanh(bend * effort) / bend) if bend else command
        return change_effort(command, moment, lambda effort: effort.clamp(-self.limit, self.limit))
