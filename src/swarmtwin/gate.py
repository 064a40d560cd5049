"""The gates before promotion: dynamics by their errors on held-out transitions, policies by roll-outs on vehicles."""

from dataclasses import dataclass

import numpy as np

from swarmtwin.errors import UserError

RESAMPLES = 2000
FEWEST_RUNS = 6
FEWEST_ROLLOUTS = 100


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


@dataclass(frozen=True)
class Trials:
    """What came of one policy's roll-outs from W starts, each (W,) bool."""

    succeeded: np.ndarray
    collided: np.ndarray


@dataclass(frozen=True)
class Demands:
    """What is asked of a policy.

    Attributes:
        least_success: the least share of the roll-outs that succeed.
        most_collisions: the largest share in which vehicles collide.
        margin: how much less success than the incumbent's can be put up with, as a share of the roll-outs.
    """

    least_success: float
    most_collisions: float
    margin: float


@dataclass(frozen=True)
class PolicyVerdict:
    """What the gate says of a policy: why it is refused, if it is, and what was found.

    Attributes:
        refusals: the demands that it does not meet.
        found: success and collisions, and the change of success against the incumbent.
    """

    refusals: tuple[str, ...]
    found: str

    @property
    def passed(self) -> bool:
        """Whether every demand is met."""
        return not self.refusals

    def __str__(self) -> str:
        return f"{self.found}: {'; '.join(self.refusals) or 'every demand is met'}"


def judge_policy(candidate: Trials, incumbent: Trials | None, demands: Demands, seed: int = 0) -> PolicyVerdict:
    """Judge a policy by its roll-outs, and against the incumbent's from the same starts, in the same order.

    It passes if it succeeds often enough, collides seldom enough, and is measurably not worse than the incumbent: the
    whole 95 % interval of the change of success, by bootstrap over pairs of roll-outs, lies above the margin.

    Raises:
        UserError: there are fewer than 100 roll-outs.
    """
    count = len(candidate.succeeded)
    if count < FEWEST_ROLLOUTS:
        raise UserError(f"{count} roll-outs are too few to judge a policy by: ask for {FEWEST_ROLLOUTS} or more")
    success, collisions = float(candidate.succeeded.mean()), float(candidate.collided.mean())
    found = f"success {success:.1%}, collisions {collisions:.1%} of {count} roll-outs on stand-ins"
    refusals = []
    if success < demands.least_success:
        refusals.append(f"success is below {demands.least_success:.0%}")
    if collisions > demands.most_collisions:
        refusals.append(f"collisions are above {demands.most_collisions:.0%}")
    if incumbent is not None:
        change = candidate.succeeded.astype(float) - incumbent.succeeded
        drawn = np.random.default_rng(seed).integers(0, count, (RESAMPLES, count))
        low, high = np.quantile(change[drawn].mean(axis=1), [0.025, 0.975])
        found += f", success {change.mean():+.1%} against the champion (95 % interval {low:+.1%} to {high:+.1%})"
        if low < -demands.margin:
            refusals.append(f"it may be worse than the champion by more than {demands.margin:.0%}")
    return PolicyVerdict(tuple(refusals), found)
