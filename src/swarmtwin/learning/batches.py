"""Transitions in memory as tensors, given out in batches by index: no loader, no copies, no workers."""

import hashlib
from collections.abc import Iterator, Sequence
from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor

from swarmtwin.errors import UserError
from swarmtwin.learning.situation import Situation
from swarmtwin.robot import DISPLACEMENT_COLUMNS, Arena, Robot, SituationPart
from swarmtwin.transitions.transitions import SPLITS, Split, Transitions

Batch = tuple[Situation, Tensor]
"""N situations and the displacements (N, 3) that followed them."""

CountedBatch = tuple[Situation, Tensor, Tensor]
"""The same, and how often each counts for each of M members of an ensemble, (N, M)."""

Examples = tuple[Tensor, Tensor]
"""The same as networks see it: scaled inputs (N, columns) and scaled displacements (N, 3)."""


class ShuffledBatches:
    """All transitions in a new order each epoch, which depends on seed and epoch alone; a short last batch is left out.

    Attributes:
        epoch: to be set before each pass.
        counts: (N, M) how often each transition counts for each of M members, given out with it; None: there are none.
    """

    def __init__(
        self, situation: Situation, displacement: Tensor, size: int, seed: int, counts: Tensor | None = None
    ) -> None:
        self.situation = situation
        self.displacement = displacement
        self.counts = counts
        self.size = min(size, len(situation))
        self.seed = seed
        self.epoch = 0

    def __len__(self) -> int:
        return len(self.situation) // self.size

    def __iter__(self) -> Iterator[Batch | CountedBatch]:
        generator = torch.Generator().manual_seed(epoch_seed(self.seed, self.epoch))
        order = torch.randperm(len(self.situation), generator=generator)
        for start in range(0, len(self) * self.size, self.size):
            rows = order[start : start + self.size]
            batch = self.situation[rows], self.displacement[rows]
            yield batch if self.counts is None else (*batch, self.counts[rows])


class OrderedBatches:
    """All transitions in their order, in slices of at most `size`."""

    def __init__(self, situation: Situation, displacement: Tensor, size: int = 8192) -> None:
        self.situation = situation
        self.displacement = displacement
        self.size = size

    def __len__(self) -> int:
        return -(-len(self.situation) // self.size)

    def __iter__(self) -> Iterator[Batch]:
        for start in range(0, len(self.situation), self.size):
            rows = slice(start, start + self.size)
            yield self.situation[rows], self.displacement[rows]


def epoch_seed(seed: int, epoch: int) -> int:
    """Return a seed of its own for each epoch of each seed's training."""
    return seed * 1_000_003 + epoch


MAY_BE_UNKNOWN: tuple[SituationPart, ...] = ("previous_command", "earlier_command", "velocity", "neighbours")


class TensorSplits(NamedTuple):
    """Measured situations and displacements (N, 3), float32, to learn from and to choose by."""

    robot: Robot
    arena_mm: Arena
    train: tuple[Situation, torch.Tensor]
    validation: tuple[Situation, torch.Tensor]

    def to(self, device: torch.device) -> "TensorSplits":
        """Return the same on a device."""
        splits = [(situation.to(device), moved.to(device)) for situation, moved in (self.train, self.validation)]
        return TensorSplits(self.robot, self.arena_mm, *splits)

    def digest(self) -> str:
        """Identify the content."""
        content = hashlib.sha256()
        for situation, displacement in (self.train, self.validation):
            for part in (*vars(situation).values(), displacement):
                if part is not None:
                    content.update(part.numpy().tobytes())
        return content.hexdigest()


def tensor_splits(transitions: Transitions, parts: Sequence[SituationPart]) -> TensorSplits:
    """Turn the training and validation splits into tensors; only commands before, velocities and neighbours may be NaN.

    Raises:
        UserError: a split is empty, a value is not finite, or a part of the situation is not there at all.
    """
    situation = Situation.from_transitions(transitions, parts)
    displacement = torch.as_tensor(transitions.displacement, dtype=torch.float32)
    _check_present(situation)
    _check_finite(situation, displacement)
    return TensorSplits(
        transitions.robot,
        transitions.arena_mm,
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
