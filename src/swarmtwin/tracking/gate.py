"""The gates before promotion: dynamics by their errors on held-out transitions, policies by roll-outs on vehicles."""

from dataclasses import dataclass

import numpy as np

from swarmtwin.errors import UserError


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
class DynamicsVerdict:
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


def judge_dynamics(
    candidate: Errors, champion: Errors, run: np.ndarray, *, fewest_runs: int = 6, resamples: int = 2000, seed: int = 0
) -> DynamicsVerdict:
    """Compare two models' errors on the same transitions, in the same order.

    Each model's error is the mean over position and orientation, each relative to the champion's. The candidate passes
    if the whole 95 % interval of the change lies below zero.

    Args:
        candidate: errors on N transitions.
        champion: likewise.
        run: (N,) which run each transition is from: runs, not transitions, are independent.
        fewest_runs: below which a percentile bootstrap over runs is no interval.
        resamples: of the runs, drawn with replacement.
        seed: of the resamples.

    Raises:
        UserError: there are fewer runs than that.
    """
    _, run = np.unique(run, return_inverse=True)
    count = np.bincount(run)
    if len(count) < fewest_runs:
        raise UserError(f"{len(count)} held-out runs are too few to judge by: record at least {fewest_runs}")
    change = 0.5 * (
        (candidate.position_mm - champion.position_mm) / champion.position_mm.mean()
        + (candidate.orientation_deg - champion.orientation_deg) / champion.orientation_deg.mean()
    )
    total = np.bincount(run, change)
    drawn = np.random.default_rng(seed).integers(0, len(count), (resamples, len(count)))
    low, high = np.quantile(total[drawn].sum(1) / count[drawn].sum(1), [0.025, 0.975])
    return DynamicsVerdict(passed=bool(high < 0), change=float(change.mean()), low=float(low), high=float(high))


@dataclass(frozen=True)
class Trials:
    """What came of one policy's roll-outs from W starts, each (W,) bool."""

    succeeded: np.ndarray
    collided: np.ndarray


@dataclass(frozen=True)
class PolicyVerdict:
    """What the gate says of a policy: why it is refused, if it is, and what was found.

    Attributes:
        refusals: the demands that it does not meet.
        found: success and collisions, and the change of success against the champion.
    """

    refusals: tuple[str, ...]
    found: str

    @property
    def passed(self) -> bool:
        """Whether every demand is met."""
        return not self.refusals

    def __str__(self) -> str:
        return f"{self.found}: {'; '.join(self.refusals) or 'every demand is met'}"


def judge_policy(
    candidate: Trials,
    champion: Trials | None,
    *,
    least_success: float,
    most_collisions: float,
    margin: float,
    fewest_rollouts: int = 100,
    resamples: int = 2000,
    seed: int = 0,
) -> PolicyVerdict:
    """Judge a policy by its roll-outs, and against the champion's from the same starts, in the same order.

    It passes if it succeeds often enough, collides seldom enough, and is measurably not worse than the champion: the
    whole 95 % interval of the change of success, by bootstrap over pairs of roll-outs, lies above the margin.

    Args:
        candidate: its roll-outs.
        champion: those of the champion, None where there is none.
        least_success: the least share of the roll-outs that must succeed.
        most_collisions: the largest share in which vehicles may collide.
        margin: how much less success than the champion's can be put up with, as a share of the roll-outs.
        fewest_rollouts: below which these shares say too little: of 100, one is a per cent.
        resamples: of the pairs, drawn with replacement.
        seed: of the resamples.

    Raises:
        UserError: there are fewer roll-outs than that.
    """
    count = len(candidate.succeeded)
    if count < fewest_rollouts:
        raise UserError(f"{count} roll-outs are too few to judge a policy by: ask for {fewest_rollouts} or more")
    success, collisions = float(candidate.succeeded.mean()), float(candidate.collided.mean())
    found = f"success {success:.1%}, collisions {collisions:.1%} of {count} roll-outs on stand-ins"
    refusals = []
    if success < least_success:
        refusals.append(f"success is below {least_success:.0%}")
    if collisions > most_collisions:
        refusals.append(f"collisions are above {most_collisions:.0%}")
    if champion is not None:
        change = candidate.succeeded.astype(float) - champion.succeeded
        drawn = np.random.default_rng(seed).integers(0, count, (resamples, count))
        low, high = np.quantile(change[drawn].mean(axis=1), [0.025, 0.975])
        found += f", success {change.mean():+.1%} against the champion (95 % interval {low:+.1%} to {high:+.1%})"
        if low < -margin:
            refusals.append(f"it may be worse than the champion by more than {margin:.0%}")
    return PolicyVerdict(tuple(refusals), found)
