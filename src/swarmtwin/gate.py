"""The gate before promotion: whether one model is measurably better than another on held-out transitions."""

from dataclasses import dataclass

import numpy as np

from swarmtwin.errors import UserError

RESAMPLES = 2000
FEWEST_RUNS = 6


@dataclass(frozen=True)
class Errors:
    """One model's one-step errors on N held-out transitions.

    Attributes:
        position_mm: (N,) Euclidean.
        orientation_deg: (N,) absolute, wrapped.
    """

    position_mm: np.ndarray
    orientation_deg: np.ndarray


@dataclass(frozen=True)
class Verdict:
    """What the gate says: whether the candidate passes, and the change of error that decided, with its 95 % interval.

    `change` is relative: −0.02 means 2 % less error, position and orientation weighed alike.
    """

    passed: bool
    change: float
    low: float
    high: float

    def __str__(self) -> str:
        figures = f"one-step error {self.change:+.2%} (95 % interval {self.low:+.2%} to {self.high:+.2%})"
        return f"{figures}: {'measurably better' if self.passed else 'not measurably better'}"


def judge(candidate: Errors, incumbent: Errors, run: np.ndarray, seed: int = 0) -> Verdict:
    """Compare two models' errors on the same transitions, in the same order; intervals by bootstrap over runs.

    `run` (N,) says which run each transition is from: runs, not transitions, are independent.
    Each model's error is the mean over position and orientation, each relative to the incumbent's. The candidate passes
    if the whole 95 % interval of the change lies below zero.

    Raises:
        UserError: there are fewer than 6 runs, too few for an interval.
    """
    runs = len(np.unique(run))
    if runs < FEWEST_RUNS:
        raise UserError(f"{runs} held-out runs are too few to judge by: record at least {FEWEST_RUNS}")
    change = 0.5 * (
        (candidate.position_mm - incumbent.position_mm) / incumbent.position_mm.mean()
        + (candidate.orientation_deg - incumbent.orientation_deg) / incumbent.orientation_deg.mean()
    )
    _, run = np.unique(run, return_inverse=True)
    total, count = np.bincount(run, change), np.bincount(run)
    drawn = np.random.default_rng(seed).integers(0, len(count), (RESAMPLES, len(count)))
    low, high = np.quantile(total[drawn].sum(1) / count[drawn].sum(1), [0.025, 0.975])
    return Verdict(passed=bool(high < 0), change=float(change.mean()), low=float(low), high=float(high))
