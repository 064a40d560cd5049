"""One-step errors, the floor beneath them, and the distance to an exact mean: pure functions of predictions."""

import math
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
import torch

from swarmtwin.dynamics.base import Dynamics
from swarmtwin.dynamics.neighbours import NeighbourRegression
from swarmtwin.dynamics.situation import Situation
from swarmtwin.errors import UserError
from swarmtwin.geometry import orientation_error_rad, position_error_mm
from swarmtwin.transitions import Transitions

FOLDS = 5
NEIGHBOURS = (20, 40, 80, 160, 320)


class ErrorFigure(NamedTuple):
    """Position and orientation errors, mean ± standard deviation over transitions, as in the paper's tables."""

    position_mm: float
    position_sd_mm: float
    orientation_deg: float
    orientation_sd_deg: float
    transitions: int

    @classmethod
    def between(cls, predicted: np.ndarray, measured: np.ndarray) -> "ErrorFigure":
        """Compare displacements (N, 3) with displacements (N, 3).

        Raises:
            UserError: there are none.
        """
        if not len(measured):
            raise UserError("there are no transitions to evaluate: record more runs, or split them otherwise")
        position_mm = position_error_mm(predicted, measured)
        orientation_deg = np.degrees(orientation_error_rad(predicted, measured))
        return cls(
            float(position_mm.mean()),
            float(position_mm.std()),
            float(orientation_deg.mean()),
            float(orientation_deg.std()),
            len(measured),
        )

    @classmethod
    def pooled(cls, figures: Sequence["ErrorFigure"]) -> "ErrorFigure":
        """Return the figure over the transitions of several."""
        weights = np.array([figure.transitions for figure in figures], dtype=float)

        def over_all(means: list[float], spreads: list[float]) -> tuple[float, float]:
            mean = np.average(means, weights=weights)
            square = np.average(np.square(means) + np.square(spreads), weights=weights)
            return float(mean), float(np.sqrt(max(square - mean**2, 0.0)))

        position = over_all([f.position_mm for f in figures], [f.position_sd_mm for f in figures])
        orientation = over_all([f.orientation_deg for f in figures], [f.orientation_sd_deg for f in figures])
        return cls(*position, *orientation, int(weights.sum()))


class FloorEstimate(NamedTuple):
    """What the best model could err, estimated from data alone by nearest neighbours.

    Neighbours miss some of what can be learned, so the estimate is too high, the more so the more inputs and the fewer
    data there are: a good network may come out below it.
    """

    error: ErrorFigure
    neighbours: int


def predict(dynamics: Dynamics, transitions: Transitions) -> np.ndarray:
    """Predict the displacements (N, 3) of measured situations, in batches, without gradients."""
    situation = Situation.from_transitions(transitions, dynamics.parts)
    with torch.inference_mode():
        slices = [slice(start, start + 8192) for start in range(0, len(situation), 8192)]
        batches = [dynamics(situation[rows]).numpy() for rows in slices]
    return np.concatenate(batches).astype(float) if batches else np.empty((0, 3))


def one_step(dynamics: Dynamics, transitions: Transitions) -> ErrorFigure:
    """Compare predictions with what was measured."""
    return ErrorFigure.between(predict(dynamics, transitions), transitions.displacement)


def floor(exact_mean: np.ndarray, transitions: Transitions) -> ErrorFigure:
    """Compare the exact mean displacements (N, 3) of a stand-in with what was measured: its noise remains.

    The mean has the least squared error. The mean distance and angle given here are least for a median: where the noise
    is skewed, and by chance on a finite sample, a model can come out below the floor by a hair.
    """
    return ErrorFigure.between(exact_mean, transitions.displacement)


def model_error(dynamics: Dynamics, transitions: Transitions, exact_mean: np.ndarray) -> ErrorFigure:
    """Compare predictions with the exact mean displacements (N, 3) of a stand-in: the noise is left out."""
    return ErrorFigure.between(predict(dynamics, transitions), exact_mean)


def neighbour_floor(dynamics: Dynamics, transitions: Transitions, scored: np.ndarray | None = None) -> FloorEstimate:
    """Estimate the floor of models that are given the same inputs as `dynamics`, from these transitions alone.

    Each transition is predicted from its nearest neighbours in the other folds, whole runs in a fold; the number of
    neighbours is the one that predicts best.

    Args:
        dynamics: says what the inputs are; its weights do not matter.
        transitions: of one vehicle, all that there are.
        scored: mask (N,) of those that count, such as the test split; None for all.

    Raises:
        UserError: there are too few, or none that count.
    """
    with torch.inference_mode():
        inputs = dynamics.encoding(Situation.from_transitions(transitions, dynamics.parts)).numpy().astype(float)
    scored = np.ones(len(transitions), bool) if scored is None else scored
    measured = transitions.displacement
    fold = _folds(transitions.run, inputs.shape[1])
    figures = {
        count: ErrorFigure.between(_cross_predicted(inputs, measured, fold, scored, count)[scored], measured[scored])
        for count in NEIGHBOURS
    }
    best = min(figures, key=lambda count: figures[count].position_mm)
    return FloorEstimate(figures[best], best)


def _folds(run: np.ndarray, columns: int) -> np.ndarray:
    """Give each transition (N,) a fold: whole runs in turn, or blocks in time where there are fewer runs than folds."""
    needed = math.ceil((columns + 1) * FOLDS / (FOLDS - 1))  # so that the other folds define a plane over the inputs
    if len(run) < needed:
        raise UserError(
            f"the floor cannot be estimated from {len(run)} transitions of a vehicle: "
            f"{columns} inputs need at least {needed}; record more runs"
        )
    runs, rank = np.unique(run, return_inverse=True)
    return rank % FOLDS if len(runs) >= FOLDS else np.arange(len(run)) * FOLDS // len(run)


def _cross_predicted(
    inputs: np.ndarray, outputs: np.ndarray, fold: np.ndarray, scored: np.ndarray, count: int
) -> np.ndarray:
    predicted = np.full_like(outputs, np.nan)
    for held_out in np.unique(fold[scored]):
        known, asked = fold != held_out, (fold == held_out) & scored
        predicted[asked] = NeighbourRegression(inputs[known], outputs[known]).predict(inputs[asked], count)
    return predicted
