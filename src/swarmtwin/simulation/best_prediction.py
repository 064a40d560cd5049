"""What the best possible model with some inputs would predict: known on a stand-in, estimated on a real robot."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np
import pandas as pd

from swarmtwin.dynamics.evaluation import neighbour_prediction
from swarmtwin.errors import UserError
from swarmtwin.recordings.exact_means import mean_columns
from swarmtwin.robot import SituationPart
from swarmtwin.transitions import Transitions

FloorKind = Literal["exact", "averaged_exact_means", "nearest_neighbours"]


@dataclass(frozen=True)
class BestPrediction:
    """Mean displacements of transitions, given some inputs.

    Attributes:
        kind: `exact`: a stand-in's conditional mean. `averaged_exact_means`: a stand-in's mean given more than the
            inputs, averaged over what they leave open, which is estimated; the measurements' noise is not in it.
            `nearest_neighbours`: estimated from the measurements alone. An estimate is never as good as the best model.
        given: the inputs.
        mean: (N, 3) forward_mm, left_mm, turn_rad; NaN for a transition that was not asked for.
    """

    kind: FloorKind
    given: tuple[SituationPart, ...]
    mean: np.ndarray

    @property
    def is_exact_mean(self) -> bool:
        """Whether it is a stand-in's, known or averaged, and not made of the measurements themselves."""
        return self.kind != "nearest_neighbours"


def best_prediction(
    transitions: Transitions, given: Sequence[SituationPart], exact: pd.DataFrame | None
) -> BestPrediction:
    """Return what the best model that is given these parts of the situation would predict.

    Args:
        transitions: N, of any vehicles; each vehicle is predicted from its own alone.
        given: the parts.
        exact: (N rows) the exact means that belong to them; None on a real robot.

    Raises:
        UserError: there are too few transitions to estimate it from.
    """
    if exact is None:
        return neighbour_estimate(transitions, given, np.ones(len(transitions), bool))
    before = next((part for part in ("earlier_command", "previous_command") if part in given), None)
    knows_situation = set(transitions.robot.situation) <= set(given)
    level = _most_informed(exact) if "velocity" in given else before or "situation"
    known = mean_columns(level if level in _levels(exact) else "everything")
    mean = exact[known].to_numpy(float)
    if knows_situation and level in _levels(exact) and "velocity" not in given:
        return BestPrediction("exact", tuple(given), mean)
    start = exact[mean_columns("situation")].to_numpy(float) if knows_situation else np.zeros_like(mean)
    return BestPrediction("averaged_exact_means", tuple(given), start + _averaged(mean - start, transitions, given))


def neighbour_estimate(transitions: Transitions, given: Sequence[SituationPart], scored: np.ndarray) -> BestPrediction:
    """Estimate from measurements alone what the best model would predict of the transitions `scored` (N,).

    Raises:
        UserError: a vehicle has too few.
    """
    columns = filled_columns(transitions, given)
    mean = np.full_like(transitions.displacement, np.nan)
    for own in _vehicles(transitions):
        if scored[own].any():
            mean[own], _ = neighbour_prediction(columns[own], transitions.where(own), scored[own])
    return BestPrediction("nearest_neighbours", tuple(given), mean)


def _averaged(values: np.ndarray, transitions: Transitions, given: Sequence[SituationPart]) -> np.ndarray:
    """Average values (N, 3) over everything but the inputs: boosted trees, learned from other runs than they predict.

    Raises:
        UserError: a vehicle has too few transitions.
    """
    from sklearn.ensemble import (
        HistGradientBoostingRegressor,
    )  # for those who evaluate, not for those who only simulate
    from sklearn.model_selection import GroupKFold, KFold

    columns, averaged = _columns(transitions, given), np.zeros_like(values)
    for own in _vehicles(transitions):
        rows, runs = np.flatnonzero(own), np.unique(transitions.run[own])
        if len(rows) < 3:
            raise UserError(
                f"the floor cannot be estimated from {len(rows)} transitions of a vehicle: record more runs"
            )
        folds = GroupKFold(3) if len(runs) >= 3 else KFold(3)
        for known, asked in folds.split(rows, groups=transitions.run[own]):
            for axis in range(values.shape[1]):
                trees = HistGradientBoostingRegressor(random_state=0)
                trees.fit(columns[rows[known]], values[rows[known], axis])
                averaged[rows[asked], axis] = trees.predict(columns[rows[asked]])
    return averaged


def _vehicles(transitions: Transitions) -> list[np.ndarray]:
    """Return the transitions (N,) of each vehicle that has any."""
    return [transitions.vehicle == number for number in np.unique(transitions.vehicle)]


def _levels(exact: pd.DataFrame) -> list[str]:
    return [name.removesuffix("_turn_rad") for name in exact.columns if name.endswith("_turn_rad")]


def _most_informed(exact: pd.DataFrame) -> str:
    """Return what the exact means are given that are given most: a velocity tells of all that was before."""
    levels = _levels(exact)
    return next(level for level in ("everything", "earlier_command", "previous_command", *levels) if level in levels)


def filled_columns(transitions: Transitions, given: Sequence[SituationPart]) -> np.ndarray:
    """Return inputs as columns (N, c), a heading as cosine and sine; the columns' means where the past is unknown."""
    known = np.ma.masked_invalid(_columns(transitions, given))
    filled: np.ndarray = np.where(known.mask, known.mean(axis=0).filled(0.0), known.data)
    return filled


def _columns(transitions: Transitions, given: Sequence[SituationPart]) -> np.ndarray:
    """Return inputs as columns (N, c), a heading as cosine and sine; NaN where the past is unknown."""
    pose = transitions.pose
    parts: dict[SituationPart, np.ndarray] = {
        "command": transitions.command,
        "previous_command": transitions.previous_command,
        "earlier_command": transitions.earlier_command,
        "pose": np.column_stack([pose[:, :2], np.cos(pose[:, 2]), np.sin(pose[:, 2])]),
        "velocity": transitions.velocity,
        "elapsed_s": transitions.time_s[:, None],
        "duration_s": transitions.duration_s[:, None],
        "neighbours": transitions.neighbours.reshape(len(transitions), -1),
    }
    return np.concatenate([parts[part] for part in given], axis=1)
