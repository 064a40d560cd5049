"""One-step errors, the floor beneath them, and the distance to an exact mean: pure functions of predictions."""

import math
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from swarmtwin.dynamics.predictor import OneStepModel
from swarmtwin.errors import UserError
from swarmtwin.geometry import orientation_error_rad, position_error_mm
from swarmtwin.learning.ensemble import folds_of
from swarmtwin.learning.nearest_neighbours import NeighbourRegression
from swarmtwin.learning.situation import Situation
from swarmtwin.transitions import Transitions


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


def predict(dynamics: OneStepModel, transitions: Transitions) -> np.ndarray:
    """Predict the displacements (N, 3) of measured situations, in the order of the transitions."""
    return dynamics.predict(Situation.from_transitions(transitions, dynamics.inputs)).numpy().astype(float)


def one_step_errors(dynamics: OneStepModel, transitions: Transitions) -> np.ndarray:
    """Return the errors (N, 2) of predictions against what was measured: position in mm, orientation in degrees."""
    predicted, measured = predict(dynamics, transitions), transitions.displacement
    turned_rad = orientation_error_rad(predicted, measured)
    return np.column_stack([position_error_mm(predicted, measured), np.degrees(turned_rad)])


def one_step(dynamics: OneStepModel, transitions: Transitions) -> ErrorFigure:
    """Compare predictions with what was measured."""
    return ErrorFigure.between(predict(dynamics, transitions), transitions.displacement)


def floor(exact_mean: np.ndarray, transitions: Transitions) -> ErrorFigure:
    """Compare the exact mean displacements (N, 3) of a stand-in with what was measured: its noise remains.

    The mean has the least squared error. The mean distance and angle given here are least for a median: where the noise
    is skewed, and by chance on a finite sample, a model can come out below the floor by a hair.
    """
    return ErrorFigure.between(exact_mean, transitions.displacement)


def model_error(dynamics: OneStepModel, transitions: Transitions, exact_mean: np.ndarray) -> ErrorFigure:
    """Compare predictions with the exact mean displacements (N, 3) of a stand-in: the noise is left out."""
    return ErrorFigure.between(predict(dynamics, transitions), exact_mean)


def neighbour_prediction(
    inputs: np.ndarray,
    transitions: Transitions,
    scored: np.ndarray,
    folds: int = 5,
    counts: Sequence[int] = (20, 40, 80, 160, 320),
) -> tuple[np.ndarray, int]:
    """Predict each transition from its nearest neighbours in the other folds, whole runs in a fold.

    What is left is an estimate, from data alone, of the least that a model with these inputs could err. Neighbours miss
    some of what can be learned, so it is too high, the more so the more inputs and the fewer data there are: a good
    network may come out below it.

    Args:
        inputs: (N, columns) what is known of each transition, without NaN.
        transitions: of one vehicle, all that there are.
        scored: mask (N,) of those that are asked for.
        folds: how many; with fewer runs they are blocks in time.
        counts: the numbers of neighbours to try.

    Returns:
        displacements (N, 3), NaN where they are not asked for, and the number of neighbours, which predicts best.

    Raises:
        UserError: there are too few, or none that are asked for.
    """
    measured = transitions.displacement
    fold = _folds(transitions.run, inputs.shape[1], folds)
    predicted = {count: _cross_predicted(inputs, measured, fold, scored, count) for count in counts}
    errors_mm = {
        count: ErrorFigure.between(mean[scored], measured[scored]).position_mm for count, mean in predicted.items()
    }
    best = min(errors_mm, key=lambda count: errors_mm[count])
    return predicted[best], best


def _folds(run: np.ndarray, columns: int, count: int) -> np.ndarray:
    needed = math.ceil((columns + 1) * count / (count - 1))  # so that the other folds define a plane over the inputs
    if len(run) < needed:
        raise UserError(
            f"the floor cannot be estimated from {len(run)} transitions of a vehicle: "
            f"{columns} inputs need at least {needed}; record more runs"
        )
    return folds_of(run, count, split_runs=True)


def _cross_predicted(
    inputs: np.ndarray, outputs: np.ndarray, fold: np.ndarray, scored: np.ndarray, count: int
) -> np.ndarray:
    predicted = np.full_like(outputs, np.nan)
    for held_out in np.unique(fold[scored]):
        known, asked = fold != held_out, (fold == held_out) & scored
        predicted[asked] = NeighbourRegression(inputs[known], outputs[known]).predict(inputs[asked], count)
    return predicted
