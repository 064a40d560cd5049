"""Regression by nearest neighbours: what a model could know at best of its inputs, estimated from data alone."""

import numpy as np
from scipy.spatial import cKDTree


class NeighbourRegression:
    """Predicts by a plane through the nearest known points, least squares with a ridge, columns standardised.

    Attributes:
        ridge: as a share of the neighbours' mean variance, so that few or collinear ones give a stable plane.
    """

    def __init__(self, inputs: np.ndarray, outputs: np.ndarray, ridge: float = 0.1) -> None:
        """Keep known inputs (N, columns) and outputs (N, d)."""
        self.ridge = ridge
        self._offset = inputs.mean(axis=0)
        spread = inputs.std(axis=0)
        self._spread = np.where(spread > 0, spread, 1)
        self._known = self._standardised(inputs)
        self._outputs = outputs
        self._tree = cKDTree(self._known)

    def predict(self, inputs: np.ndarray, count: int) -> np.ndarray:
        """Return predictions (M, d) for inputs (M, columns) from the `count` nearest known points of each."""
        asked = self._standardised(inputs)
        chunks = np.array_split(asked, max(1, len(asked) // 4096))  # a bound on memory
        return np.concatenate([self._predict(chunk, min(count, len(self._known))) for chunk in chunks])

    def _predict(self, asked: np.ndarray, count: int) -> np.ndarray:
        _, nearest = self._tree.query(asked, k=np.arange(1, count + 1))
        around, outputs = self._known[nearest] - asked[:, None], self._outputs[nearest]
        centre, level = around.mean(axis=1, keepdims=True), outputs.mean(axis=1, keepdims=True)
        transposed = (around - centre).swapaxes(1, 2)
        normal = transposed @ (around - centre)
        size = np.trace(normal, axis1=1, axis2=2)[:, None, None] / normal.shape[1]
        stabilised = normal + (self.ridge * size + 1e-12) * np.eye(normal.shape[1])
        slope = np.linalg.solve(stabilised, transposed @ (outputs - level))
        predicted: np.ndarray = (level - centre @ slope)[:, 0]
        return predicted

    def _standardised(self, inputs: np.ndarray) -> np.ndarray:
        standardised: np.ndarray = (inputs - self._offset) / self._spread
        return standardised
