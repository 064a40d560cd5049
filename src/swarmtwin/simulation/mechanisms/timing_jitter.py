"""Periods differ from nominal, and the motion goes with them: a busy controller."""

from collections.abc import Mapping
from typing import ClassVar, Literal

import numpy as np
import torch
from scipy import optimize, stats
from torch import Tensor

from swarmtwin.robot import Robot, SituationPart
from swarmtwin.simulation.conditions import SessionConditions
from swarmtwin.simulation.mechanism import Mechanism, Parameter


class Config(Mechanism):
    """The motion lasts as long as the period really does; `spread` is the periods' standard deviation over nominal."""

    stage: ClassVar = "clock"
    words: ClassVar = (
        "control periods vary, with a standard deviation of {spread} of the nominal one, and the motion with them"
    )
    remedy: ClassVar = "take load off the controller, or use the measured duration as an input"
    parameters: ClassVar[Mapping[str, Parameter]] = {}
    inputs: ClassVar[tuple[SituationPart, ...]] = ("duration_s",)

    name: Literal["timing_jitter"] = "timing_jitter"
    spread: float

    @classmethod
    def read_from_clock(cls, duration_s: np.ndarray, robot: Robot) -> dict[str, float] | None:
        """Read the spread off the clock; None where periods differ by no more than times are rounded to.

        It is the likeliest of normal deviations from nominal that are not seen where a period lasts too long.
        """
        period_s, longest = robot.period_s, robot.longest_gap_s / robot.period_s - 1
        deviation = duration_s / period_s - 1
        if np.std(deviation) <= 0.003:
            return None
        squares = float((deviation**2).mean())

        def loss(log_spread: float) -> float:
            spread = np.exp(log_spread)
            return float(squares / (2 * spread**2) + log_spread + stats.norm.logcdf(longest / spread))

        found = optimize.minimize_scalar(loss, bounds=(np.log(1e-3), 0.0), method="bounded", options={"xatol": 1e-4})
        return {"spread": float(np.exp(found.x))}

    @classmethod
    def bounds_of(cls, robot: Robot, conditions: SessionConditions) -> Mapping[str, Parameter]:
        """Allow periods that often last half as long again."""
        return {"spread": Parameter(0.0, 0.5, 0.0, "", ())}

    @classmethod
    def units(cls, robot: Robot, conditions: SessionConditions) -> dict[str, str]:
        """Return the unit of what is reported."""
        return {"spread": ""}

    def follows_clock(self) -> bool:
        """Say that the motion lasts as long as the period."""
        return True

    def draw_duration_s(self, count: int, period_s: float, rng: torch.Generator) -> Tensor:
        """Draw the lengths (N,) of periods, normal about nominal; none is shorter than a tenth of it."""
        drawn = torch.randn(count, generator=rng, dtype=torch.float64, device=rng.device)
        return period_s * (1.0 + self.spread * drawn).clamp(min=0.1)
