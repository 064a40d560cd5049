"""Control periods on the monotonic clock: each begins when it is due, and how late it began is kept."""

import math
import time
from collections.abc import Callable

import numpy as np


class Ticker:
    """Gives the beginnings of periods. What was missed is left out: no two periods are ever nearer than planned.

    Attributes:
        period_s: between two beginnings.
        due_s: when the next one is due, on the monotonic clock.
        lateness_s: by how much each began late.
        missed: how many were left out.
    """

    def __init__(self, period_s: float, first_s: float, clock: Callable[[], float] = time.monotonic) -> None:
        self.period_s = period_s
        self.due_s = first_s
        self.lateness_s: list[float] = []
        self.missed = 0
        self._clock = clock

    def wait(self, beat: Callable[[], bool], beat_s: float, sleep: Callable[[float], None] = time.sleep) -> bool:
        """Wait until the next period is due, calling `beat` every `beat_s`; return False as soon as that does.

        The last stretch is slept through in one piece, so that a period begins when it is due.
        """
        while True:
            if not beat():
                return False
            left_s = self.due_s - self._clock()
            if left_s <= 0:
                break
            sleep(min(left_s, beat_s) if left_s > 1.5 * beat_s else left_s)
        self._begin()
        return True

    def shift(self, by_s: float, largest_share: float) -> None:
        """Let the next period begin later by `by_s`, earlier if negative, but by a share of the period at most."""
        most_s = largest_share * self.period_s
        self.due_s += min(max(by_s, -most_s), most_s)

    def _begin(self) -> None:
        late_s = self._clock() - self.due_s
        self.lateness_s.append(late_s)
        left_out = math.floor(late_s / self.period_s)
        self.missed += left_out
        self.due_s += (1 + left_out) * self.period_s


def median_and_p99(values_s: list[float]) -> tuple[float, float]:
    """Return the median and the 99th percentile of some times; NaN where there are none."""
    if not values_s:
        return math.nan, math.nan
    return float(np.median(values_s)), float(np.quantile(values_s, 0.99))
