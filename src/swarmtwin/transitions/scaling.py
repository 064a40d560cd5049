"""How the columns of transitions are scaled, learned from the training part only."""

from typing import Self

import numpy as np

from swarmtwin.errors import UserError
from swarmtwin.robot import DISPLACEMENT_COLUMNS, POSE_COLUMNS, StrictModel
from swarmtwin.transitions.transitions import Transitions


class ColumnScaling(StrictModel):
    """The range and spread of one column, in its unit."""

    low: float
    high: float
    mean: float
    sd: float


class Scaling(StrictModel):
    """The scaling of each column, by name; synthetic transitions lack some columns.

    Attributes:
        situation: what a model may be given: command, pose, elapsed time and duration.
        displacement: what it returns: forward_mm, left_mm, turn_rad.
    """

    situation: dict[str, ColumnScaling]
    displacement: dict[str, ColumnScaling]

    @classmethod
    def learn(cls, transitions: Transitions) -> Self:
        """Learn the scaling from those of `transitions` in the split "train"; the others have no influence.

        Raises:
            UserError: there are none.
        """
        training = transitions.part("train")
        if not len(training):
            raise UserError("no transition is in the split 'train': nothing to learn the scaling from")
        situation = {
            **_columns(training.robot.command_columns, training.command),
            **_columns(POSE_COLUMNS, training.pose),
            **_columns(("time_s", "duration_s"), np.column_stack([training.time_s, training.duration_s])),
        }
        return cls(situation=situation, displacement=_columns(DISPLACEMENT_COLUMNS, training.displacement))


def _columns(names: tuple[str, ...], values: np.ndarray) -> dict[str, ColumnScaling]:
    return {
        name: ColumnScaling(
            low=float(column.min()), high=float(column.max()), mean=float(column.mean()), sd=float(column.std())
        )
        for name, column in zip(names, values.T, strict=True)
        if not np.isnan(column).all()
    }
