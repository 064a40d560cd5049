"""Pictures to calibrate from: several, so that noise averages out and vehicles that move are seen at several places."""

import numpy as np

from swarmtwin.deploy.camera.camera import Camera
from swarmtwin.errors import UserError


def take_pictures(
    camera: Camera, count: int = 12, apart_s: float = 0.1, timeout_s: float = 5.0, farthest: int = 3000
) -> list[np.ndarray]:
    """Take several pictures: of a live camera the next ones, of a source that ends some that are spread over it.

    Args:
        camera: that gives them.
        count: of pictures, at most.
        apart_s: at least between two of a camera that is live.
        timeout_s: within which each must come.
        farthest: no picture after so many of a source that ends is looked at.

    Raises:
        UserError: there is no picture at all.
        CameraLostError: none came in time.
    """
    pictures = _live(camera, count, apart_s, timeout_s) if camera.is_live else _spread(camera, count, farthest)
    if not pictures:
        raise UserError(f"{camera.source}: there is no picture to calibrate from")
    return pictures


def _live(camera: Camera, count: int, apart_s: float, timeout_s: float) -> list[np.ndarray]:
    pictures: list[np.ndarray] = []
    number, last_s = -1, -np.inf
    while len(pictures) < count and (frame := camera.next_frame(number, timeout_s)) is not None:
        number = frame.number
        if frame.captured_s >= last_s + apart_s:
            pictures.append(frame.image)
            last_s = frame.captured_s
    return pictures


def _spread(camera: Camera, count: int, farthest: int) -> list[np.ndarray]:
    """Return pictures at equal distances; where there turn out to be more, every second one is let go of."""
    pictures: list[np.ndarray] = []
    every, looked_at, number = 1, 0, -1
    while looked_at < farthest and (frame := camera.next_frame(number)) is not None:
        number = frame.number
        if looked_at % every == 0:
            pictures.append(frame.image)
        looked_at += 1
        if len(pictures) >= 2 * count:
            pictures, every = pictures[::2], 2 * every
    return pictures[:: -(-len(pictures) // count)] if pictures else []
