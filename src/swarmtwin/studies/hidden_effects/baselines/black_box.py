"""A black-box residual: boosted trees learn what the simulation gets wrong. They name nothing."""

import numpy as np
from sklearn.ensemble import HistGradientBoostingRegressor

from swarmtwin.geometry import residual_between
from swarmtwin.transitions import Transitions


def learned_residual(transitions: Transitions, simulated: np.ndarray, held_out: np.ndarray, seed: int) -> np.ndarray:
    """Return the simulation's displacements (N, 3) with what boosted trees add to them.

    Args:
        transitions: N measured ones.
        simulated: (N, 3) their simulated displacements.
        held_out: (N,) those that nothing is fitted to.
        seed: of the trees.
    """
    inputs = _features(transitions)
    residual = residual_between(simulated, transitions.displacement)
    added = np.zeros_like(residual)
    for axis in range(3):
        trees = HistGradientBoostingRegressor(
            max_iter=120,  # small trees and a slow rate: a session has a few thousand transitions
            max_leaf_nodes=12,
            learning_rate=0.08,
            min_samples_leaf=40,
            early_stopping=False,
            random_state=seed,
        )
        added[:, axis] = trees.fit(inputs[~held_out], residual[~held_out, axis]).predict(inputs)
    return simulated + added


def _features(transitions: Transitions) -> np.ndarray:
    """Return (N, columns) the whole situation; trees take what is not known as it is."""
    heading_rad = transitions.pose[:, 2]
    columns = [
        transitions.command,
        transitions.previous_command,
        transitions.pose[:, :2],
        np.stack([np.cos(heading_rad), np.sin(heading_rad)], axis=1),
        transitions.time_s[:, None],
        transitions.duration_s[:, None],
        transitions.neighbours.reshape(len(transitions), transitions.neighbours.shape[1] * 3),
    ]
    return np.concatenate(columns, axis=1)
