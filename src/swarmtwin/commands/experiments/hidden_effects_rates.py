"""Shares of cases with honest bounds: every figure of the study says how many cases it was counted over."""

from collections.abc import Iterable
from typing import Self

from scipy import stats

from swarmtwin.robot import StrictModel

NORMAL_95 = 1.959963984540054


class Share(StrictModel):
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
        """Count."""
        cases = list(happened)
        count, total = sum(cases), len(cases)
        if not total:
            return cls(count=0, total=0, share=None, low=0.0, high=1.0, at_most=1.0)
        share, square = count / total, NORMAL_95**2 / total
        centre = (share + square / 2) / (1 + square)
        half = (square * share * (1 - share) + square**2 / 4) ** 0.5 / (1 + square)
        at_most = 1.0 if count == total else float(stats.beta.ppf(0.95, count + 1, total - count))
        return cls(
            count=count,
            total=total,
            share=share,
            low=max(0.0, centre - half),
            high=min(1.0, centre + half),
            at_most=at_most,
        )

    def __str__(self) -> str:
        if self.share is None:
            return "–"
        return f"{self.share:.1%} ({self.count}/{self.total})"

    def with_bounds(self) -> str:
        """Return it as a person reads it, with its interval."""
        return "–" if self.share is None else f"{self} [{self.low:.1%}, {self.high:.1%}]"
