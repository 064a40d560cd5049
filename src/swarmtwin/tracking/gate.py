"""The gates: dynamics by their errors on held-out transitions, policies by roll-outs from the same starts."""

from dataclasses import dataclass
from typing import NamedTuple, Self

import numpy as np

from swarmtwin.errors import UserError


@dataclass(frozen=True)
class Errors:
    """One model's one-step errors on the held-out transitions of R runs; runs, not transitions, are independent.

    Attributes:
        position_mm: (R,) mean over a run's transitions, Euclidean.
        orientation_deg: (R,) likewise, absolute, wrapped.
        transitions: (R,) how many each run has.
    """

    position_mm: np.ndarray
    orientation_deg: np.ndarray
    transitions: np.ndarray

    @classmethod
    def by_run(cls, one_step: np.ndarray, run: np.ndarray) -> Self:
        """Sum up errors (N, 2) in mm and degrees, of transitions in runs (N,)."""
        _, run = np.unique(run, return_inverse=True)
        transitions = np.bincount(run)
        position_mm, orientation_deg = (np.bincount(run, errors) / transitions for errors in one_step.T)
        return cls(position_mm, orientation_deg, transitions)

    @property
    def mean(self) -> tuple[float, float]:
        """The mean errors over all transitions, in mm and degrees."""
        position_mm, orientation_deg = (
            float(np.average(errors, weights=self.transitions)) for errors in (self.position_mm, self.orientation_deg)
        )
        return position_mm, orientation_deg


@dataclass(frozen=True)
class DynamicsVerdict:
    """What the gate says: whether the candidate passes, and the change of error that decided, with its 95 % interval.

    `change` is relative: −0.02 means 2 % less error, position and orientation weighed alike.
    """

    passed: bool
    change: float
    low: float
    high: float

    @property
    def gain(self) -> str:
        """What is gained, in words, by a candidate that passes."""
        return f"{-self.change:.1%} smaller (95 % interval {-self.high:.1%} to {-self.low:.1%} smaller)"

    def __str__(self) -> str:
        figures = f"one-step error {self.change:+.2%} (95 % interval {self.low:+.2%} to {self.high:+.2%})"
        return f"{figures}: {'measurably better' if self.passed else 'not measurably better'}"


def judge_dynamics(
    candidate: Errors, rival: Errors, *, fewest_runs: int = 6, resamples: int = 2000, seed: int = 0
) -> DynamicsVerdict:
    """Compare two models' errors on the same transitions, in the same order of runs.

    Each model's error is the mean over position and orientation, each relative to the rival's. The candidate passes if
    the whole 95 % interval of the change lies below zero.

    Args:
        candidate: errors on R runs.
        rival: likewise, of the champion, the challenger or a plain baseline.
        fewest_runs: below which a percentile bootstrap over runs is no interval.
        resamples: of the runs, drawn with replacement.
        seed: of the resamples.

    Raises:
        UserError: there are fewer runs than that.
    """
    count = rival.transitions
    if len(count) < fewest_runs:
        raise UserError(f"{len(count)} held-out runs are too few to judge by: record at least {fewest_runs}")
    position_mm, orientation_deg = rival.mean
    total = (
        0.5
        * count
        * (
            (candidate.position_mm - rival.position_mm) / position_mm
            + (candidate.orientation_deg - rival.orientation_deg) / orientation_deg
        )
    )
    drawn = np.random.default_rng(seed).integers(0, len(count), (resamples, len(count)))
    low, high = np.quantile(total[drawn].sum(1) / count[drawn].sum(1), [0.025, 0.975])
    change = float(total.sum() / count.sum())
    return DynamicsVerdict(passed=bool(high < 0), change=change, low=float(low), high=float(high))


@dataclass(frozen=True)
class Trials:
    """What came of one policy's roll-outs from W starts.

    Attributes:
        succeeded: (W,) bool.
        collided: (W,) bool.
        reward: (W,) mean reward a vehicle and step.
        what: they were, in words.
        paired: whether they began where the other policy's did, in the same order.
    """

    succeeded: np.ndarray
    collided: np.ndarray
    reward: np.ndarray
    what: str = "roll-outs on stand-ins"
    paired: bool = True


@dataclass(frozen=True)
class PolicyVerdict:
    """What is said of a policy: why it is refused, if it is, and what was found.

    Attributes:
        refusals: the demands that it does not meet.
        found: success and collisions, and the changes against the other policy.
        approval: what is said where it is not refused.
    """

    refusals: tuple[str, ...]
    found: str
    approval: str = "every demand is met"

    @property
    def passed(self) -> bool:
        """Whether every demand is met."""
        return not self.refusals

    def __str__(self) -> str:
        return f"{self.found}: {'; '.join(self.refusals) or self.approval}"


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
    """Judge a policy by its roll-outs, and against the champion's, from the same starts in the same order if paired.

    It passes if its estimated success is high enough, its estimated collisions are few enough, and it is measurably not
    worse than the champion: the whole 95 % interval of the change of success, by bootstrap over pairs of roll-outs, or
    over each policy's own where they are not paired, lies above the margin.

    Args:
        candidate: its roll-outs.
        champion: those of the champion, None where there is none.
        least_success: the least share of the roll-outs that must succeed.
        most_collisions: the share in which vehicles collide must be below this.
        margin: how much less success than the champion's can be put up with, as a share of the roll-outs.
        fewest_rollouts: below which these shares say too little: of 100, one is a per cent.
        resamples: of the pairs, drawn with replacement.
        seed: of the resamples.

    Raises:
        UserError: there are fewer roll-outs than that.
    """
    count = len(candidate.succeeded)
    if count < fewest_rollouts:
        raise UserError(f"{count} {candidate.what} are too few to judge a policy by: ask for {fewest_rollouts} or more")
    success, collisions = float(candidate.succeeded.mean()), float(candidate.collided.mean())
    found = f"success {success:.1%}, collisions {collisions:.1%} of {count} {candidate.what}"
    refusals = []
    if success < least_success:
        refusals.append(f"success is below {least_success:.0%}")
    if collisions >= most_collisions:
        refusals.append(f"collisions are not below {most_collisions:.0%}")
    if champion is not None:
        compare = _change if candidate.paired and champion.paired else _change_between
        change, low, high = compare(candidate.succeeded, champion.succeeded, resamples, seed)
        found += f", success {change:+.1%} against the champion (95 % interval {low:+.1%} to {high:+.1%})"
        if low < -margin:
            refusals.append(f"it may be worse than the champion by more than {margin:.0%}")
    return PolicyVerdict(tuple(refusals), found)


def judge_challenging_policy(
    candidate: Trials, challenger: Trials, *, resamples: int = 2000, seed: int = 0
) -> PolicyVerdict:
    """Say whether a policy is measurably better than the challenger from the same starts, in the same order.

    It is if it succeeds measurably more often, or earns measurably more and succeeds measurably less often not, and in
    neither case collides measurably more often; by 95 % intervals, from a bootstrap over pairs of roll-outs.

    Args:
        candidate: its roll-outs.
        challenger: those of the challenger.
        resamples: of the pairs, drawn with replacement.
        seed: of the resamples.
    """
    success, collisions, reward = (
        _change(getattr(candidate, figure), getattr(challenger, figure), resamples, seed)
        for figure in ("succeeded", "collided", "reward")
    )
    better = success.low > 0 or (success.high >= 0 and reward.low > 0)
    refusals = [] if better else ["it is not measurably better"]
    if collisions.low > 0:
        refusals.append("it collides measurably more often")
    found = (
        f"success {success.mean:+.1%} (95 % interval {success.low:+.1%} to {success.high:+.1%}), reward "
        f"{reward.mean:+.3f} ({reward.low:+.3f} to {reward.high:+.3f}) in {len(candidate.succeeded)} roll-outs in the "
        "simulation from the same starts"
    )
    return PolicyVerdict(tuple(refusals), found, "measurably better")


class _Change(NamedTuple):
    mean: float
    low: float
    high: float


def _change(after: np.ndarray, before: np.ndarray, resamples: int, seed: int) -> _Change:
    """Return by how much the mean over pairs (W,) rises, with its 95 % interval by bootstrap over the pairs."""
    change = after.astype(float) - before
    drawn = np.random.default_rng(seed).integers(0, len(change), (resamples, len(change)))
    low, high = np.quantile(change[drawn].mean(axis=1), [0.025, 0.975])
    return _Change(float(change.mean()), float(low), float(high))


def _change_between(after: np.ndarray, before: np.ndarray, resamples: int, seed: int) -> _Change:
    """Return by how much the mean of (W,) is above that of others (U,), with its 95 % interval by bootstrap of each."""
    rng = np.random.default_rng(seed)
    means = [
        values.astype(float)[rng.integers(0, len(values), (resamples, len(values)))].mean(axis=1)
        for values in (after, before)
    ]
    low, high = np.quantile(means[0] - means[1], [0.025, 0.975])
    return _Change(float(after.mean() - before.mean()), float(low), float(high))
