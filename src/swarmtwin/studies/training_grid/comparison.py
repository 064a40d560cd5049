"""Two trainings compared: the difference of their errors with its interval, and what it says of a claim."""

from collections.abc import Mapping
from typing import Literal, NamedTuple

import numpy as np

from swarmtwin.robot import Positive, StrictModel
from swarmtwin.studies.training_grid.measured_errors import RunErrors
from swarmtwin.studies.training_grid.table_file import Quantity

Relation = Literal["better", "not_worse", "not_better"]
Verdict = Literal["holds", "does not hold", "cannot be told"]

HOLDS: Verdict = "holds"
FAILS: Verdict = "does not hold"
OPEN: Verdict = "cannot be told"


class Judging(StrictModel):
    """How comparisons are judged.

    Attributes:
        margin: a difference of this share of the error compared with counts as none.
        fewest_runs: with fewer measured runs nothing can be told.
        resamples: of runs and seeds, that an interval is made of.
        seed: of the resamples.
    """

    margin: Positive
    fewest_runs: int
    resamples: int
    seed: int


class Difference(NamedTuple):
    """How much more one training errs than another, on the same runs and by the same seeds.

    Attributes:
        error: of the first, in the quantity's unit, mean over seeds.
        other_error: of the second.
        difference: the first less the second.
        low: of its 95 % interval.
        high: likewise.
        seeds: how many pairs of trainings there are.
        runs: how many measured runs.
    """

    error: float
    other_error: float
    difference: float
    low: float
    high: float
    seeds: int
    runs: int

    def verdict(self, relation: Relation, judging: Judging) -> Verdict:
        """Say whether the whole interval speaks for a relation, against it, or neither.

        `better`: the first errs less. `not_worse`: it errs less than the margin more. `not_better`: it errs less than
        the margin less.
        """
        if self.runs < judging.fewest_runs:
            return OPEN
        margin = judging.margin * self.other_error
        match relation:
            case "better":
                speaks_for, speaks_against = self.high < 0, self.low >= 0
            case "not_worse":
                speaks_for, speaks_against = self.high < margin, self.low > margin
            case "not_better":
                speaks_for, speaks_against = self.low > -margin, self.high < -margin
        return HOLDS if speaks_for else FAILS if speaks_against else OPEN


def compare(
    first: Mapping[int, RunErrors], second: Mapping[int, RunErrors], quantity: Quantity, judging: Judging
) -> Difference | None:
    """Compare two trainings by a paired bootstrap over runs and seeds; None where no seed of both is alive.

    Seeds are drawn one fewer than there are, with replacement, so that the variance of their mean is that of a mean of
    all of them (Rao and Wu, 1988); drawn as many it would come out a third too small of three. With a single seed the
    interval is over runs alone.

    Args:
        first: errors by run, by seed, on one recording.
        second: likewise, on the same runs.
        quantity: which errors.
        judging: how many resamples.
    """
    seeds = sorted(first.keys() & second.keys())
    if not seeds:
        return None
    errors = np.array([[one[seed].values(quantity) for seed in seeds] for one in (first, second)])
    weights = first[seeds[0]].weights(quantity)
    known = np.isfinite(errors).all(axis=(0, 1)) & (weights > 0)
    if not known.any():
        return None
    errors, weights = errors[:, :, known], weights[known]
    rng = np.random.default_rng(judging.seed)
    runs = rng.integers(0, len(weights), (judging.resamples, len(weights)))
    drawn = rng.integers(0, len(seeds), (judging.resamples, max(1, len(seeds) - 1)))
    by_seed = errors[0] - errors[1]
    share = weights[runs] / weights[runs].sum(axis=1, keepdims=True)
    means = np.einsum("brs,br->bs", by_seed.T[runs], share)
    resampled = np.take_along_axis(means, drawn, axis=1).mean(axis=1)
    low, high = np.quantile(resampled, [0.025, 0.975])
    mean, other = (float(np.average(one.mean(axis=0), weights=weights)) for one in errors)
    return Difference(mean, other, mean - other, float(low), float(high), len(seeds), int(known.sum()))


def overall(verdicts: list[Verdict]) -> Verdict:
    """Return the verdict on a claim that several comparisons are to bear out: it holds if all of them do."""
    if FAILS in verdicts:
        return FAILS
    return HOLDS if verdicts and all(verdict == HOLDS for verdict in verdicts) else OPEN
