"""Periods differ from nominal, and the motion goes with them: a busy controller."""

from typing import ClassVar, Literal

import numpy as np
from torch import Tensor

from swarmtwin.gap.mechanism import Drive, Mechanism
from swarmtwin.robot import Robot, SituationPart

SMALLEST = 0.003


class Config(Mechanism):
    """The motion lasts as long as the period really does; `spread` is the periods' standard deviation over nominal."""

    words: ClassVar = "control periods differ by {spread} from nominal, and the motion with them"
    remedy: ClassVar = "take load off the controller, or use the measured duration as an input"
    quantities: ClassVar = {}
    needs: ClassVar[tuple[SituationPart, ...]] = ("duration_s",)
    uses_history: ClassVar = True

    name: Literal["timing_jitter"] = "timing_jitter"
    spread: float

    @classmethod
    def observed(cls, duration_s: np.ndarray, period_s: float) -> dict[str, float] | None:
        """Read the spread off the clock; there is nothing to explain where periods do not differ."""
        spread = float(np.std(duration_s) / period_s)
        return {"spread": spread} if spread > SMALLEST else None

    @classmethod
    def units(cls, robot: Robot) -> dict[str, str]:
        """Return the unit of what is told."""
        return {"spread": ""}

    def duration(self, drive: Drive) -> Tensor:
        """Return the periods' measured lengths in nominal periods."""
        return drive.duration_s / drive.robot.period_s
