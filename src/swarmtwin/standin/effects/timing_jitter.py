"""Periods differ from nominal, and the motion goes with them: a busy controller."""

from typing import Annotated

import numpy as np
from pydantic import Field

from swarmtwin.standin.effect import Effect, Rng


class TimingJitter(Effect):
    """Each period has its own length; the recorded times show it.

    Attributes:
        spread: standard deviation of a period's length over its nominal length; deviations end at three of them.
    """

    spread: Annotated[float, Field(gt=0, le=0.3)] = 0.08

    def durations(self, nominal: np.ndarray, rng: Rng) -> np.ndarray:
        """Draw the periods' lengths."""
        deviation = np.clip(rng.standard_normal(nominal.shape), -3.0, 3.0)
        return nominal * (1.0 + self.spread * deviation)
