"""Finds dead networks: an output that stays constant although the motion varies with the inputs."""

import numpy as np

from swarmtwin.learning.nearest_neighbours import NeighbourRegression
from swarmtwin.robot import DISPLACEMENT_COLUMNS


def dead_outputs(
    predicted: np.ndarray,
    measured: np.ndarray,
    inputs: np.ndarray,
    *,
    least_spread: float = 0.01,
    least_explained: float = 0.1,
    neighbours: int = 50,
) -> list[str]:
    """Name the displacement components that a network cannot produce any more.

    Args:
        predicted: (N, 3) displacements by the network on validation data.
        measured: (N, 3) measured displacements.
        inputs: (N, columns) what the network was given.
        least_spread: a component is constant if its standard deviation is below this share of the measured one's. A
            fair prediction's is at least √`least_explained`, 0.3 by default.
        least_explained: the inputs count as explaining a component if neighbours predict this share of its variance.
        neighbours: at most so many.
    """
    constant = predicted.std(axis=0) < least_spread * measured.std(axis=0)
    if not constant.any():
        return []
    predictable = _explained_share(measured, inputs, neighbours) > least_explained
    return [name for name, dead in zip(DISPLACEMENT_COLUMNS, constant & predictable, strict=True) if dead]


def _explained_share(measured: np.ndarray, inputs: np.ndarray, neighbours: int) -> np.ndarray:
    """Estimate per component the share of variance that the inputs explain, on the half not learned from."""
    known, asked = slice(0, None, 2), slice(1, None, 2)
    count = min(neighbours, max(1, len(measured) // 10))
    expected = NeighbourRegression(inputs[known], measured[known]).predict(inputs[asked], count)
    left = ((measured[asked] - expected) ** 2).mean(axis=0)
    variance = measured[asked].var(axis=0)
    share: np.ndarray = 1 - left / np.where(variance > 0, variance, np.inf)
    return np.where(variance > 0, share, 0)
