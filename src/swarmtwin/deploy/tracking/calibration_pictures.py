"""Pictures to calibrate from: several, so that noise averages out and vehicles that move are seen at several places."""

import numpy as np

from swarmtwin.deploy.camera.camera import Camera
from swarmtwin.errors import UserError


def take_pictures(camera: Camera, count: int = 12, apart_s: float = 0.1, timeout_s: float = 5.0) -> list[np.ndarray]:
    """Take several pictures; fewer where the source ends.

    Args:
        camera: that gives them.
        count: of pictures, at most.
        apart_s: at least between two of a camera that is live or of a video.
        timeout_s: within which each must come.

    Raises:
        UserError: there is no picture at all.
        CameraLostError: none came in time.
    """
    pictures: list[np.ndarray] = []
    number, last_s = -1, -np.inf
    while len(pictures) < count:
        frame = camera.next_frame(number, timeout_s)
        if frame is None:
            break
        number = frame.number
        if frame.captured_s >= last_s + apart_s:
            pictures.append(frame.image)
            last_s = frame.captured_s
    if not pictures:
        raise UserError(f"{camera.source}: there is no picture to calibrate from")
    return pictures
