"""The newest picture of a camera that gives them at its own pace: one thread puts them in, another takes the last."""

import threading
import time
from dataclasses import dataclass
from typing import Any, Generic, TypeVar

import numpy as np

from swarmtwin.deploy.camera.camera import CameraLostError

Content = TypeVar("Content")


@dataclass(frozen=True)
class Arrival(Generic[Content]):
    """A picture as it came.

    Attributes:
        number: counts those that came, from 0.
        captured_s: when it was taken, on the monotonic clock.
        content: the picture, decoded or not.
    """

    number: int
    captured_s: float
    content: Content


class NewestPicture(Generic[Content]):
    """Holds one picture; whoever is slow misses those between and never gets an old one."""

    def __init__(self, source: str) -> None:
        self._source = source
        self._newest: Arrival[Content] | None = None
        self._silent_since_s = time.monotonic()
        self._trouble: str | None = None
        self._is_closed = False
        self._changed = threading.Condition()

    def put(self, content: Content, captured_s: float) -> None:
        """Replace the picture by a newer one; what was wrong is over.

        The very same picture once more is none: no two exposures have the same noise, so the camera is frozen, whatever
        its stamps say.
        """
        with self._changed:
            if self._newest is not None and _are_identical(content, self._newest.content):
                self._trouble = "it gives the same picture again and again: it is frozen"
                return
            number = 0 if self._newest is None else self._newest.number + 1
            self._newest = Arrival(number, captured_s, content)
            self._silent_since_s, self._trouble = time.monotonic(), None
            self._changed.notify_all()

    def trouble(self, reason: str) -> None:
        """Say why no pictures come at present."""
        with self._changed:
            self._trouble = reason

    def close(self) -> None:
        """Give nothing any more."""
        with self._changed:
            self._is_closed = True
            self._changed.notify_all()

    def wait(self, after: int, timeout_s: float) -> Arrival[Content]:
        """Return the newest picture whose number is greater than `after`.

        Raises:
            CameraLostError: none came in time, or the camera was closed.
        """
        with self._changed:
            self._changed.wait_for(lambda: self._is_closed or self._is_newer(after), timeout_s)
            if self._newest is not None and self._newest.number > after and not self._is_closed:
                return self._newest
            if self._is_closed:
                raise CameraLostError(f"{self._source} was closed: open it again")
            silent_s = time.monotonic() - self._silent_since_s
            reason = self._trouble or "it is silent: look after the camera and its cable or network"
            raise CameraLostError(f"{self._source} has given no picture for {silent_s:.1f} s: {reason}")

    def _is_newer(self, after: int) -> bool:
        return self._newest is not None and self._newest.number > after


def _are_identical(one: Any, other: Any) -> bool:
    return np.array_equal(one, other) if isinstance(one, np.ndarray) else bool(one == other)
