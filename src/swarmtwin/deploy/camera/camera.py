"""What a camera gives: pictures with the time at which they were taken."""

from dataclasses import dataclass
from typing import Protocol

import numpy as np

from swarmtwin.errors import RefusedError


@dataclass(frozen=True)
class Frame:
    """One picture.

    Attributes:
        number: counts the camera's pictures from 0; where some are missed, numbers are, too.
        captured_s: when it was taken, on this machine's monotonic clock (`time.monotonic()`); of a file that is played
            as fast as it can be read, seconds since its beginning.
        image: (H, W) grey or (H, W, 3) blue, green, red, uint8.
    """

    number: int
    captured_s: float
    image: np.ndarray


class CameraLostError(RefusedError):
    """A camera that gave pictures gives none any more; the message says which and for how long."""


class Camera(Protocol):
    """Pictures, the newest first: what is too old to be of use is never handed out by one that is live.

    Attributes:
        source: where they come from, in words.
        size: width and height in pixels.
        is_live: whether pictures come at their own pace; else each is waited for.
    """

    source: str
    size: tuple[int, int]
    is_live: bool

    def next_frame(self, after: int = -1, timeout_s: float = 1.0) -> Frame | None:
        """Return the newest picture (of a file the next one) whose number is greater than `after`; None: the end.

        Raises:
            CameraLostError: none came within `timeout_s`, or the camera is gone.
        """

    def close(self) -> None:
        """Let go of the camera; twice does no harm."""
