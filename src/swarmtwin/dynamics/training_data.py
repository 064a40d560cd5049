"""Transitions become the tensors that a model learns from and is chosen by."""

import hashlib
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
import torch

from swarmtwin.dynamics.base import Batch
from swarmtwin.dynamics.situation import Situation
from swarmtwin.errors import UserError
from swarmtwin.robot import DISPLACEMENT_COLUMNS, Robot, SituationPart
from swarmtwin.transitions.transitions import SPLITS, Split, Transitions

MAY_BE_UNKNOWN: tuple[SituationPart, ...] = ("previous_command", "earlier_command", "neighbours")


class TrainingData(NamedTuple):
    """Measured situations and displacements (N, 3), float32, to learn from and to choose by."""

    robot: Robot
    train: tuple[Situation, torch.Tensor]
    validation: tuple[Situation, torch.Tensor]

    def digest(self) -> str:
        """Identify the content."""
        content = hashlib.sha256()
        for situation, displacement in (self.train, self.validation):
            for part in (*vars(situation).values(), displacement):
                if part is not None:
                    content.update(part.numpy().tobytes())
        return content.hexdigest()


def training_data(transitions: Transitions, parts: Sequence[SituationPart]) -> TrainingData:
    """Turn the training and validation splits into tensors; only commands before and neighbours may be NaN.

    Raises:
        UserError: a split is empty, a value is not finite, or a part of the situation is not there at all.
    """
    situation = Situation.from_transitions(transitions, parts)
    displacement = torch.as_tensor(transitions.displacement, dtype=torch.float32)
    _check_present(situation)
    _check_finite(situation, displacement)
    return TrainingData(
        transitions.robot,
        _split(transitions, "train", situation, displacement),
        _split(transitions, "validation", situation, displacement),
    )


def _split(transitions: Transitions, split: Split, situation: Situation, displacement: torch.Tensor) -> Batch:
    rows = torch.from_numpy(np.flatnonzero(transitions.split == SPLITS.index(split)))
    if len(rows) < 2:
        raise UserError(f"the {split} split has {len(rows)} transitions: record more runs, or split them otherwise")
    return situation[rows], displacement[rows]


def _check_present(situation: Situation) -> None:
    for name, part in vars(situation).items():
        if part is not None and len(part) and part.isnan().all():
            raise UserError(
                f"the model looks at {name}, which these transitions do not hold; synthetic ones hold what their "
                "generator learned: take it out of model.situation, or train on real transitions, prepared anew"
            )


def _check_finite(situation: Situation, displacement: torch.Tensor) -> None:
    parts = {name: part for name, part in vars(situation).items() if part is not None and name not in MAY_BE_UNKNOWN}
    parts |= dict(zip(DISPLACEMENT_COLUMNS, displacement.T, strict=True))
    for name, part in parts.items():
        if count := int((~part.isfinite()).reshape(len(part), -1).any(dim=1).sum()):
            raise UserError(f"{name} is not finite in {count} of {len(part)} transitions: prepare the recording anew")
