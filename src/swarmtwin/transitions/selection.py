"""A part of the real transitions: what a laboratory would have that had recorded less."""

import numpy as np

from swarmtwin.errors import UserError
from swarmtwin.transitions.transitions import SPLITS, Transitions


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


def _first(part: Transitions, share: float) -> np.ndarray:
    """Return the first runs that come nearest to `share` transitions: at least one, where there is any."""
    runs, first, sizes = np.unique(part.run, return_index=True, return_counts=True)
    in_order = np.argsort(first)
    if not len(runs):
        return runs
    reached = np.cumsum(sizes[in_order])
    return runs[in_order][: int(np.argmin(np.abs(reached - share))) + 1]
