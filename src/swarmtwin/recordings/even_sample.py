"""An even part of what passes by, in memory that does not grow with it."""

import numpy as np


class EvenSample:
    """Keeps all of a sequence while it is short, and of a long one every second, fourth, eighth … element.

    Which ones are kept depends on their places in the sequence alone, not on the pieces in which it arrives.

    Attributes:
        seen: how many elements have passed by.
    """

    def __init__(self, most: int) -> None:
        """Begin with nothing.

        Args:
            most: elements to keep at a time. At least half as many are kept once more have passed by.
        """
        self.most = most
        self.seen = 0
        self._every = 1
        self._kept: list[tuple[np.ndarray, ...]] = []

    def due(self, count: int) -> np.ndarray:
        """Return the places, from 0, of those that are kept among the next `count` elements."""
        return np.arange(-self.seen % self._every, count, self._every)

    def add(self, count: int, *due: np.ndarray) -> None:
        """Let `count` elements pass by.

        Args:
            count: how many.
            due: arrays (D, ...) of what is kept of the elements that `due(count)` names.
        """
        self.seen += count
        self._kept.append(tuple(np.array(column) for column in due))
        while sum(len(columns[0]) for columns in self._kept) > self.most:
            self._kept = [tuple(column[::2].copy() for column in self.columns())]
            self._every *= 2

    def columns(self) -> tuple[np.ndarray, ...]:
        """Return the arrays (D, ...) kept, in order; none before anything has passed by."""
        if len(self._kept) > 1:
            self._kept = [tuple(np.concatenate(pieces) for pieces in zip(*self._kept, strict=True))]
        return self._kept[0] if self._kept else ()
