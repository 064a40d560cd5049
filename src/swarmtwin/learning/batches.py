"""Transitions in memory as tensors, given out in batches by index: no loader, no copies, no workers."""

import hashlib
from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor

from swarmtwin.errors import UserError
from swarmtwin.learning.situation import Situation, field_of
from swarmtwin.robot import DISPLACEMENT_COLUMNS, Arena, Robot, SituationPart
from swarmtwin.transitions.source import TransitionSource
from swarmtwin.transitions.transitions import SPLITS

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
                    content.update(part.contiguous().numpy().data)
        return content.hexdigest()


def tensor_splits(transitions: TransitionSource, parts: Sequence[SituationPart]) -> TensorSplits:
    """Turn the training and validation splits into tensors; only commands before, velocities and neighbours may be NaN.

    Beside the tensors, no more than a block of the transitions is in memory.

    Raises:
        UserError: a split is empty, a value is not finite, or a part of the situation is not there at all.
    """
    train, validation = (_Filled(transitions.count(split)) for split in ("train", "validation"))
    seen = _Seen()
    for block in transitions.blocks(dict.fromkeys((*map(field_of, parts), "displacement", "split"))):
        situation = Situation.from_fields(block, parts)
        tensors = {name: part for name, part in vars(situation).items() if part is not None}
        tensors["displacement"] = torch.as_tensor(block["displacement"], dtype=torch.float32)
        seen.look_at(tensors)
        for split, filled in (("train", train), ("validation", validation)):
            filled.take(tensors, torch.from_numpy(np.flatnonzero(block["split"] == SPLITS.index(split))))
    seen.check()
    for split, filled in (("train", train), ("validation", validation)):
        if filled.count < 2:
            raise UserError(
                f"the {split} split has {filled.count} transitions: record more runs, or split them otherwise"
            )
    return TensorSplits(transitions.robot, transitions.arena_mm, train.examples(), validation.examples())


class _Filled:
    """Tensors of a split, filled block by block: there is room for all its transitions from the first block on."""

    def __init__(self, count: int) -> None:
        self.count = count
        self._tensors: dict[str, Tensor] = {}
        self._filled = 0

    def take(self, block: Mapping[str, Tensor], rows: Tensor) -> None:
        """Take some rows of a block."""
        end = self._filled + len(rows)
        for name, part in block.items():
            if name not in self._tensors:
                self._tensors[name] = part.new_empty((self.count, *part.shape[1:]))
            torch.index_select(part, 0, rows, out=self._tensors[name][self._filled : end])
        self._filled = end

    def examples(self) -> tuple[Situation, Tensor]:
        """Return the situations and the displacements."""
        parts = dict(self._tensors)
        displacement = parts.pop("displacement")
        return Situation(**parts), displacement


class _Seen:
    """What has been seen of tensors (N, ...) by name: how many rows, any value or none, how many not finite."""

    def __init__(self) -> None:
        self._rows = 0
        self._not_finite: Counter[str] = Counter()
        self._known: dict[str, bool] = {}

    def look_at(self, block: Mapping[str, Tensor]) -> None:
        """Look at a block."""
        if not len(block["displacement"]):
            return
        self._rows += len(block["displacement"])
        for name, part in block.items():
            if name != "displacement":
                self._known[name] = self._known.get(name, False) or not bool(part.isnan().all())
        certain = {name: part for name, part in block.items() if name not in (*MAY_BE_UNKNOWN, "displacement")}
        certain |= dict(zip(DISPLACEMENT_COLUMNS, block["displacement"].T, strict=True))
        for name, part in certain.items():
            self._not_finite[name] += int((~part.isfinite()).reshape(len(part), -1).any(dim=1).sum())

    def check(self) -> None:
        """Check that all parts hold something, and numbers where there must be some.

        Raises:
            UserError: a part of the situation is not there at all, or a value is not finite.
        """
        for name, known in self._known.items():
            if not known:
                raise UserError(
                    f"the model looks at {name}, which these transitions do not hold; synthetic ones hold what their "
                    "generator learned: take it out of model.situation, or train on real transitions, prepared anew"
                )
        for name, count in self._not_finite.items():
            if count:
                raise UserError(
                    f"{name} is not finite in {count} of {self._rows} transitions: prepare the recording anew"
                )
