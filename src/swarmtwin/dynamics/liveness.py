"""Finds dead networks: an output that stays constant although the motion varies with the inputs."""

import numpy as np

from swarmtwin.dynamics.neighbours import NeighbourRegression
from swarmtwin.robot import DISPLACEMENT_COLUMNS

# The inputs count as explaining a component if neighbours predict at least this share of its variance.
LEAST_EXPLAINED = 0.1
# Then a fair prediction's standard deviation is at least √0.1 ≈ 0.3 of the measured one's: far below it is constant.
LEAST_SPREAD = 0.01
NEIGHBOURS = 50


def dead_outputs(predicted: np.ndarray, measured: np.ndarray, inputs: np.ndarray) -> list[str]:
    """Name the displacement components that a network cannot produce any more.

    Args:
        predicted: (N, 3) displacements by the network on validation data.
        measured: (N, 3) measured displacements.
        inputs: (N, columns) what the network was given.
    """
    constant = predicted.std(axis=0) < LEAST_SPREAD * measured.std(axis=0)
    if not constant.any():
        return []
    predictable = _explained_share(measured, inputs) > LEAST_EXPLAINED
    return [name for name, dead in zip(DISPLACEMENT_COLUMNS, constant & predictable, strict=True) if dead]


def _explained_share(measured: np.ndarray, inputs: np.ndarray) -> np.ndarray:
    """Estimate per component the share of variance that the inputs explain, on the half not learned from."""
    known, asked = slice(0, None, 2), slice(1, None, 2)
    neighbours = min(NEIGHBOURS, max(1, len(measured) // 10))
    expected = NeighbourRegression(inputs[known], measured[known]).predict(inputs[asked], neighbours)
    left = ((measured[asked] - expected) ** 2).mean(axis=0)
    variance = measured[asked].var(axis=0)
    share: np.ndarray = 1 - left / np.where(variance > 0, variance, np.inf)
    return np.where(variance > 0, share, 0)
