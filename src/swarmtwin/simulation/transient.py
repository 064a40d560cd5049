"""What a sudden change of thrust's setting brings about beyond steady motion, such as a recoil from the fin's throw."""

import math
from collections.abc import Iterable
from typing import NamedTuple, Self


class Transient(NamedTuple):
    """What is left of it, and when it comes.

    Attributes:
        shares: of how it moves vehicles forward, to the left and around, what is left in the period of the change.
        goes_on: share of what these lack that comes in the next period.
        lag_s: time constant with which it dies away once the command acts; 0: within the period.
    """

    shares: tuple[float, float, float] = (1.0, 1.0, 1.0)
    goes_on: float = 0.0
    lag_s: float = 0.0

    @classmethod
    def combined(cls, transients: Iterable[Self]) -> Self:
        """Return what several leave of it together."""
        shares, goes_on, lag_s = zip(cls(), *transients, strict=True)
        ahead, left, turn = (math.prod(axis) for axis in zip(*shares, strict=True))
        return cls((ahead, left, turn), min(sum(goes_on), 1.0), sum(lag_s))
