"""What the best possible model would still err on a real robot, where nobody knows it: an estimate, its interval."""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from swarmtwin.dynamics.evaluation import ErrorFigure
from swarmtwin.geometry import residual_between
from swarmtwin.learning.ensemble import folds_of
from swarmtwin.learning.noise_variance import noise_variance
from swarmtwin.robot import SituationPart
from swarmtwin.simulation.best_prediction import filled_columns
from swarmtwin.transitions import Transitions


class EstimatedFloor(NamedTuple):
    """The least error of a model with some inputs, as far as data tell.

    Attributes:
        error: as estimated, never more than that of the models whose errors it was estimated from.
        position_mm: ends of the 95 % interval of the mean position error.
        orientation_deg: likewise of the mean orientation error.
    """

    error: ErrorFigure
    position_mm: tuple[float, float]
    orientation_deg: tuple[float, float]


def estimated_floor(
    transitions: Transitions, given: Sequence[SituationPart], models: Sequence[np.ndarray], folds: int = 5
) -> EstimatedFloor:
    """Estimate what of a model's errors no smooth function of the inputs would take away.

    The variance of the noise is that of the Gamma test on what the best of some models leaves, so that the better it
    is, the surer the floor; the errors' distribution is taken to keep its shape. With too few transitions nothing is
    known but that the floor lies between 0 and that model's error.

    Args:
        transitions: N, none of which the models have seen.
        given: what the best possible model would look at.
        models: (N, 3) displacements that each predicts; they look at this, or at less.
        folds: parts of each vehicle's runs; neighbours are of another one.
    """
    errors = [residual_between(predicted, transitions.displacement) for predicted in models]
    nearest = min(errors, key=lambda one: _error_of(one).position_mm)
    straightest = min(errors, key=lambda one: _error_of(one).orientation_deg)
    left = np.column_stack([nearest[:, :2], straightest[:, 2]])
    fold = np.zeros(len(left), int)
    for vehicle in np.unique(transitions.vehicle):
        own = transitions.vehicle == vehicle
        fold[own] = folds_of(transitions.run[own], folds, split_runs=True)
    independent = fold if len(np.unique(transitions.run)) < folds else transitions.run
    noise = noise_variance(filled_columns(transitions, given), left, transitions.vehicle, fold, independent)
    if noise is None:
        whole = _error_of(left)
        return EstimatedFloor(whole, (0.0, whole.position_mm), (0.0, whole.orientation_deg))
    square = np.maximum((left**2).mean(axis=0), 1e-300)
    error = _error_of(left * np.sqrt(np.minimum(noise.value / square, 1.0)))
    drawn = [_error_of(left * np.sqrt(np.minimum(one / square, 1.0))) for one in noise.drawn(200)]
    position_mm, orientation_deg = (
        tuple(float(end) for end in np.quantile([getattr(one, name) for one in drawn], [0.025, 0.975]))
        for name in ("position_mm", "orientation_deg")
    )
    return EstimatedFloor(error, (position_mm[0], position_mm[1]), (orientation_deg[0], orientation_deg[1]))


def _error_of(left: np.ndarray) -> ErrorFigure:
    return ErrorFigure.between(np.zeros_like(left), left)
