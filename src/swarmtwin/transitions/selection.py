"""A part of the real transitions: what a laboratory would have that had recorded less, and what is held out."""

from collections.abc import Collection

import numpy as np

from swarmtwin.errors import UserError
from swarmtwin.transitions.transitions import SPLITS, Split, Transitions


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


def held_out(transitions: Transitions, splits: Collection[Split], most: int) -> Transitions:
    """Keep the first whole runs of some splits, in their order, that hold at most `most` transitions together.

    The very first run is kept whatever it holds, so that nothing is left only where the splits are empty.
    """
    chosen = np.isin(transitions.split, [SPLITS.index(split) for split in splits])
    runs, sizes = np.unique(transitions.run[chosen], return_counts=True)
    kept = runs[: max(1, int(np.searchsorted(np.cumsum(sizes), most, side="right")))]
    return transitions.where(chosen & np.isin(transitions.run, kept))


def _first(part: Transitions, share: float) -> np.ndarray:
    """Return the first runs that come nearest to `share` transitions: at least one, where there is any."""
    runs, first, sizes = np.unique(part.run, return_index=True, return_counts=True)
    in_order = np.argsort(first)
    if not len(runs):
        return runs
    reached = np.cumsum(sizes[in_order])
    return runs[in_order][: int(np.argmin(np.abs(reached - share))) + 1]
