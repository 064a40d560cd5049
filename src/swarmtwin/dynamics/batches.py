"""Transitions in memory as tensors, given out in batches by index: no loader, no copies, no workers."""

from collections.abc import Iterator

import torch
from torch import Tensor

from swarmtwin.dynamics.base import Batch
from swarmtwin.dynamics.situation import Situation


class ShuffledBatches:
    """All transitions in a new order each epoch, which depends on seed and epoch alone; a short last batch is left out.

    Attributes:
        epoch: to be set before each pass.
    """

    def __init__(self, situation: Situation, displacement: Tensor, size: int, seed: int) -> None:
        self.situation = situation
        self.displacement = displacement
        self.size = min(size, len(situation))
        self.seed = seed
        self.epoch = 0

    def __len__(self) -> int:
        return len(self.situation) // self.size

    def __iter__(self) -> Iterator[Batch]:
        generator = torch.Generator().manual_seed(epoch_seed(self.seed, self.epoch))
        order = torch.randperm(len(self.situation), generator=generator)
        for start in range(0, len(self) * self.size, self.size):
            rows = order[start : start + self.size]
            yield self.situation[rows], self.displacement[rows]


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
