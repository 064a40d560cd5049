"""Shares of cases with their intervals, and what cases are sorted by: how much an effect raises the error."""

from collections.abc import Iterable
from typing import Self

import numpy as np
import pandas as pd
from scipy.stats import binomtest

from swarmtwin.robot import StrictModel
from swarmtwin.world.rollout import Rate

RISE_BINS = {"below 3 %": (-float("inf"), 3.0), "3 to 10 %": (3.0, 10.0), "10 % or more": (10.0, float("inf"))}
"""By how much an effect raises the one-step error, in percent: from the first figure to below the second."""

FAINT, MIDDLE, CLEAR = RISE_BINS


class Proportion(StrictModel):
    """How often something happened, with Wilson's 95 % interval.

    Attributes:
        count: how often.
        total: of how many cases.
        share: null where there is no case.
        low: lower end of the interval.
        high: upper end.
        at_most: upper 95 % bound by Clopper and Pearson, which is never too low (one-sided).
    """

    count: int
    total: int
    share: float | None
    low: float
    high: float
    at_most: float

    @classmethod
    def of(cls, happened: Iterable[bool]) -> Self:
        """Count in how many of the cases it happened."""
        cases = [bool(case) for case in happened]
        count, total = sum(cases), len(cases)
        if not total:
            return cls(count=0, total=0, share=None, low=0.0, high=1.0, at_most=1.0)
        _, low, high = Rate.of(np.array(cases))
        at_most = binomtest(count, total, alternative="less").proportion_ci(0.95, method="exact").high
        return cls(count=count, total=total, share=count / total, low=low, high=high, at_most=float(at_most))

    def __str__(self) -> str:
        return "–" if self.share is None else f"{self.share:.1%} ({self.count}/{self.total})"


Proportions = dict[str, Proportion]


def in_rise_bin(table: pd.DataFrame, name: str) -> pd.Series:
    """Say of each case whether the effect raised the error by as much as a bin says."""
    low, high = RISE_BINS[name]
    return table.rise_percent.between(low, high, inclusive="left")


def median(values: pd.Series) -> float | None:
    """Return the median of what is known; None where nothing is."""
    known = values.dropna().astype(float)
    return float(known.median()) if len(known) else None


def median_and_most(values: pd.Series) -> dict[str, float | None]:
    """Return the median and the largest of what is known; None where nothing is."""
    known = values.dropna().astype(float)
    return {"median": median(values), "most": float(known.max()) if len(known) else None}
