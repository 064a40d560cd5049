"""Periods differ from nominal, always or by chance, and the motion goes with them: a busy controller."""

import math
from collections.abc import Mapping
from typing import ClassVar, Literal

import numpy as np
import torch
from scipy import optimize, stats
from torch import Tensor

from swarmtwin.recordings.rows import at_most
from swarmtwin.robot import Robot, SituationPart
from swarmtwin.simulation.conditions import SessionConditions
from swarmtwin.simulation.mechanism import Mechanism, Parameter


class Config(Mechanism):
    """The motion lasts as long as the period: `mean` times nominal, with a standard deviation of `spread` of it."""

    stage: ClassVar = "clock"
    words: ClassVar = (
        "control periods last {mean} times as long as nominal on average, with a standard deviation of {spread}, and "
        "the motion lasts as long"
    )
    remedy: ClassVar = "take load off the controller, or use the measured duration as an input"
    parameters: ClassVar[Mapping[str, Parameter]] = {}
    inputs: ClassVar[tuple[SituationPart, ...]] = ("duration_s",)

    name: Literal["timing_jitter"] = "timing_jitter"
    spread: float
    mean: float = 1.0

    @classmethod
    def read_from_clock(cls, duration_s: np.ndarray, robot: Robot) -> dict[str, float] | None:
        """Read both off the clock; None where periods differ from nominal by no more than times are rounded to.

        They are the likeliest of normal periods that are not seen where they last too long, the mean among those that
        may be seen.
        """
        lasted, longest = duration_s / robot.period_s, robot.longest_gap_s / robot.period_s
        if math.sqrt(((lasted - 1) ** 2).mean()) <= 0.003:
            return None
        mean, variance = float(lasted.mean()), float(lasted.var())
        all_seen = mean + 5 * math.sqrt(variance) < longest or not at_most(duration_s.max(), robot.longest_gap_s)
        if all_seen:
            return {"spread": math.sqrt(variance), "mean": mean}

        def loss(values: np.ndarray) -> float:
            at, spread = values[0], np.exp(values[1])
            unseen = stats.norm.logcdf((longest - at) / spread)
            return float((variance + (mean - at) ** 2) / (2 * spread**2) + values[1] + unseen)

        bounds = [(1.0 - (longest - 1), longest), (math.log(1e-3), math.log(0.5))]
        start = np.clip([mean, math.log(max(variance, 1e-12)) / 2], *np.transpose(bounds))
        found = optimize.minimize(loss, start, method="L-BFGS-B", bounds=bounds, options={"ftol": 1e-12})
        return {"spread": float(np.exp(found.x[1])), "mean": float(found.x[0])}

    @classmethod
    def bounds_of(cls, robot: Robot, conditions: SessionConditions) -> Mapping[str, Parameter]:
        """Allow periods that often last half as long again, and on average from half as long to twice."""
        return {"spread": Parameter(0.0, 0.5, 0.0, "", ()), "mean": Parameter(0.5, 2.0, 1.0, "", ())}

    @classmethod
    def units(cls, robot: Robot, conditions: SessionConditions) -> dict[str, str]:
        """Return the units of what is reported."""
        return {"spread": "", "mean": ""}

    def follows_clock(self) -> bool:
        """Say that the motion lasts as long as the period."""
        return True

    def draw_duration_s(self, count: int, period_s: float, rng: torch.Generator) -> Tensor:
        """Draw the lengths (N,) of periods, normal; none is shorter than a tenth of the nominal one."""
        drawn = torch.randn(count, generator=rng, dtype=torch.float64, device=rng.device)
        return period_s * (self.mean + self.spread * drawn).clamp(min=0.1)
