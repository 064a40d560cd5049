"""By how much an effect raises the error of a simulation that does not know it, and how large it must be for that."""

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, Self

import numpy as np
from sklearn.ensemble import HistGradientBoostingRegressor

from swarmtwin.dynamics.evaluation import ErrorFigure
from swarmtwin.transitions import Transitions


@dataclass(frozen=True)
class PlainSimulation:
    """Boosted trees that learned the reference: quick to learn, and the same for every family of stand-ins.

    Attributes:
        trees: one for each part of the displacement.
    """

    trees: tuple[Any, Any, Any]

    @classmethod
    def learn(cls, transitions: Transitions, rounds: int = 100, leaves: int = 20) -> Self:
        """Learn the displacement from command, previous command and pose."""
        inputs = _inputs(transitions)
        one, two, three = (
            HistGradientBoostingRegressor(max_iter=rounds, max_leaf_nodes=leaves, early_stopping=False).fit(inputs, own)
            for own in transitions.displacement.T
        )
        return cls((one, two, three))

    def error(self, transitions: Transitions) -> ErrorFigure:
        """Return its mean one-step errors on measured transitions."""
        inputs = _inputs(transitions)
        predicted = np.stack([own.predict(inputs) for own in self.trees], axis=1)
        return ErrorFigure.between(predicted, transitions.displacement)


def _inputs(transitions: Transitions) -> np.ndarray:
    heading_rad = transitions.pose[:, 2]
    direction = np.stack([np.cos(heading_rad), np.sin(heading_rad)], axis=1)
    return np.concatenate(
        [transitions.command, transitions.previous_command, transitions.pose[:, :2], direction], axis=1
    )


def rise_percent(now: ErrorFigure, usual: ErrorFigure) -> float:
    """Return by how much one-step errors are larger than those of the clean twin: the larger of both rises."""
    rise = max(now.position_mm / usual.position_mm, now.orientation_deg / usual.orientation_deg)
    return 100.0 * (rise - 1.0)


def size_that_raises(
    wanted_percent: float, sizes: tuple[float, float], rise: Callable[[float], float], halvings: int = 5
) -> float:
    """Return the size at which an effect raises the error by so much, or the largest where none does.

    The range is halved on a logarithmic scale; between the two sizes that are left the rise counts as proportional to a
    power of the size.

    Args:
        wanted_percent: by how much.
        sizes: the smallest and the largest.
        rise: by how many percent an effect of a size raises the error; infinite where no vehicle can have it.
        halvings: of the range.
    """
    low, high = (math.log(size) for size in sizes)
    below, above = 0.0, rise(sizes[1])
    if above <= wanted_percent:
        return sizes[1]
    for _ in range(halvings):
        middle = (low + high) / 2
        reached = rise(math.exp(middle))
        if reached < wanted_percent:
            low, below = middle, reached
        else:
            high, above = middle, reached
    if below <= 0.0:
        return math.exp((low + high) / 2)
    share = math.log(wanted_percent / below) / math.log(above / below)
    return math.exp(low + share * (high - low))
