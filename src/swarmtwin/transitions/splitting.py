"""Splits by run, never by row: neighbouring transitions share noise and place, so a split by row would leak."""

import dataclasses
from collections.abc import Collection

import numpy as np
from pydantic import Field, model_validator

from swarmtwin.errors import UserError
from swarmtwin.robot import Seed, StrictModel
from swarmtwin.transitions.source import TransitionSource
from swarmtwin.transitions.transitions import SPLITS, Split, Transitions


class Fractions(StrictModel):
    """The share of the transitions that each split should get; a split with 0 gets no run."""

    train: float = Field(gt=0, le=1)
    validation: float = Field(ge=0, lt=1)
    test: float = Field(ge=0, lt=1)

    @model_validator(mode="after")
    def _sum_to_one(self) -> "Fractions":
        total = self.train + self.validation + self.test
        if abs(total - 1) > 1e-6:
            raise ValueError(f"train, validation and test must sum to 1, not {total:g}")
        return self

    def of(self, split: str) -> float:
        """Return the share of `split`."""
        return float(getattr(self, split))


class SplitOptions(StrictModel):
    """The configuration of a split, as in conf/split/by_run.yaml: each part's share, and the seed of the draw."""

    fractions: Fractions
    seed: Seed


def split_by_run(transitions: Transitions, fractions: Fractions, seed: int) -> Transitions:
    """Assign whole runs to the splits, as `splits_of_runs` says.

    Raises:
        UserError: there are fewer runs than splits that want one.
    """
    sizes = np.bincount(transitions.run, minlength=len(transitions.runs))
    return dataclasses.replace(transitions, split=splits_of_runs(sizes, fractions, seed)[transitions.run])


def splits_of_runs(sizes: np.ndarray, fractions: Fractions, seed: int) -> np.ndarray:
    """Give each run a split, at random, so that each split's share of the transitions is near its fraction.

    The smaller splits choose first, each at least one run; a run is taken while it brings the split nearer to its
    share. The same sizes, fractions and seed give the same splits.

    Args:
        sizes: (R,) how many transitions each run has; one that has none counts for nothing.
        fractions: the shares wanted.
        seed: of the draw.

    Returns:
        (R,) index into `SPLITS`.

    Raises:
        UserError: there are fewer runs than splits that want one.
    """
    wanted = sorted((split for split in SPLITS if fractions.of(split) > 0), key=fractions.of)
    order = np.random.default_rng(seed).permutation(np.flatnonzero(sizes))
    if len(order) < len(wanted):
        runs = "1 run" if len(order) == 1 else f"{len(order)} runs"
        parts = ", ".join(split for split in SPLITS if split in wanted)
        raise UserError(
            f"{runs} with transitions cannot be split into {parts}, at least one run each: record at least "
            f"{len(wanted)} runs, or set a fraction to 0"
        )
    total = int(sizes.sum())
    split_of_run = np.full(len(sizes), SPLITS.index(wanted[-1]), dtype=np.int8)
    for position, split in enumerate(wanted[:-1]):
        still_wanted = len(wanted) - 1 - position
        taken = _runs_for(sizes[order], fractions.of(split) * total, len(order) - still_wanted)
        split_of_run[order[:taken]] = SPLITS.index(split)
        order = order[taken:]
    return split_of_run


def _runs_for(sizes: np.ndarray, share: float, most: int) -> int:
    """Return how many of the first runs come nearest to `share` transitions: at least 1, at most `most`."""
    reached = np.cumsum(sizes[:most])
    return int(np.argmin(np.abs(reached - share))) + 1


def first_runs(transitions: Transitions, count: int) -> Transitions:
    """Keep the first whole runs that make about `count` transitions to learn from, training and validation together.

    Their shares stay as they are; the test split is left out.

    Raises:
        UserError: there are fewer.
    """
    parts = [transitions.part("train"), transitions.part("validation")]
    available = sum(len(part) for part in parts)
    if count > available:
        raise UserError(f"there are {available} real transitions for training and validation: ask for at most as many")
    kept = [run for part in parts for run in _first(part, count * len(part) / available)]
    return transitions.where(np.isin(transitions.run, kept) & (transitions.split != SPLITS.index("test")))


def held_out(transitions: TransitionSource, splits: Collection[Split], most: int) -> Transitions:
    """Keep the first whole runs of some splits, in their order, that hold at most `most` transitions together.

    The very first run is kept whatever it holds, so that nothing is left only where the splits are empty.
    """
    numbers = [SPLITS.index(split) for split in splits]
    sizes = np.zeros(len(transitions.runs), dtype=int)
    for block in transitions.blocks(("run", "split")):
        sizes += np.bincount(block["run"][np.isin(block["split"], numbers)], minlength=len(sizes))
    runs = np.flatnonzero(sizes)
    kept = runs[: max(1, int(np.searchsorted(np.cumsum(sizes[runs]), most, side="right")))]
    return transitions.chosen(lambda run, split: np.isin(split, numbers) & np.isin(run, kept))


def _first(part: Transitions, share: float) -> np.ndarray:
    """Return the first runs that come nearest to `share` transitions: at least one, where there is any."""
    runs, first, sizes = np.unique(part.run, return_index=True, return_counts=True)
    in_order = np.argsort(first)
    if not len(runs):
        return runs
    reached = np.cumsum(sizes[in_order])
    return runs[in_order][: int(np.argmin(np.abs(reached - share))) + 1]
