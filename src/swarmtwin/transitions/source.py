"""What learning needs of transitions, whether they are in memory or in a file."""

from collections.abc import Callable, Collection, Iterator
from typing import Protocol

import numpy as np

from swarmtwin.robot import Arena, Robot
from swarmtwin.transitions.transitions import Fields, Split, Transitions


class TransitionSource(Protocol):
    """Transitions that can be passed through block by block; `Transitions` are one block."""

    @property
    def robot(self) -> Robot:
        """The robot they were measured on."""

    @property
    def arena_mm(self) -> Arena:
        """Where its vehicles could move."""

    @property
    def runs(self) -> tuple[str, ...]:
        """Names of the runs."""

    @property
    def vehicles(self) -> tuple[str, ...]:
        """Ids of the vehicles."""

    def __len__(self) -> int: ...

    def blocks(self, names: Collection[str]) -> Iterator[Fields]:
        """Yield the arrays of these names, block after block in the order of the transitions."""

    def chosen(self, choose: Callable[[np.ndarray, np.ndarray], np.ndarray]) -> Transitions:
        """Return, in memory, the transitions that a function of their run and split, (n,) each, chooses by a mask."""

    def part(self, split: Split) -> Transitions:
        """Return, in memory, the transitions of one split."""

    def count(self, split: Split) -> int:
        """Return how many transitions a split has."""

    def digests(self) -> dict[Split, str]:
        """Return the digest of each split's transitions."""
