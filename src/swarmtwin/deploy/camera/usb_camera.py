"""A camera that is plugged into this machine."""

import threading
import time
from collections.abc import Callable

import cv2
import numpy as np

from swarmtwin.deploy.camera.camera import CameraLostError, Frame
from swarmtwin.deploy.camera.newest_picture import NewestPicture
from swarmtwin.errors import UserError


class UsbCamera:
    """Grabs pictures in a thread and keeps the newest; a picture's time is that at which it was grabbed.

    How long the camera exposes and transfers before that cannot be asked for, and is not in a picture's age. A camera
    that is pulled out is opened anew until it is closed here.
    """

    is_live = True

    def __init__(
        self, open_device: Callable[[], cv2.VideoCapture], name: str, patience_s: float = 5.0, pause_s: float = 0.2
    ) -> None:
        """Open the camera and wait for its first picture.

        Args:
            open_device: see `video_device`.
            name: of the camera, for messages.
            patience_s: how long to wait for the first picture.
            pause_s: between two attempts to open it anew.

        Raises:
            UserError: there is no such camera, or it gives no pictures.
        """
        self.source = name
        self._open_device, self._pause_s = open_device, pause_s
        self._device = open_device()
        if not self._device.isOpened():
            self._device.release()
            raise UserError(
                f"there is no {name}, or another program has it: numbers start at 0, see v4l2-ctl --list-devices"
            )
        self._newest: NewestPicture[np.ndarray] = NewestPicture(name)
        self._is_closed = threading.Event()
        self._thread = threading.Thread(target=self._grab_for_ever, name=name, daemon=True)
        self._thread.start()
        try:
            first = self._newest.wait(-1, patience_s)
        except CameraLostError as lost:
            self.close()
            raise UserError(f"{lost}") from None
        self.size = first.content.shape[1], first.content.shape[0]

    def next_frame(self, after: int = -1, timeout_s: float = 1.0) -> Frame | None:
        """Return the newest picture whose number is greater than `after`, see `Camera`.

        Raises:
            CameraLostError: none came in time, or they have another size now.
        """
        arrival = self._newest.wait(after, timeout_s)
        size = arrival.content.shape[1], arrival.content.shape[0]
        if size != self.size:
            raise CameraLostError(f"{self.source} gives pictures of {size} pixels now, and of {self.size} at first")
        return Frame(arrival.number, arrival.captured_s, arrival.content)

    def close(self) -> None:
        """Let go of the camera."""
        self._is_closed.set()
        self._newest.close()
        self._thread.join(2.0)

    def _grab_for_ever(self) -> None:
        while not self._is_closed.is_set():
            if self._device.grab():
                grabbed_s = time.monotonic()
                was_read, picture = self._device.retrieve()
                if was_read:
                    self._newest.put(picture, grabbed_s)
                continue
            self._newest.trouble("it is gone: is it plugged in?")
            self._device.release()
            if not self._is_closed.wait(self._pause_s):
                self._device = self._open_device()
        self._device.release()


def video_device(
    device: int | str, size: tuple[int, int] = (1920, 1080), frames_per_s: float = 30.0
) -> cv2.VideoCapture:
    """Open a camera of this machine; the driver takes what it has nearest to the size and rate that are asked for.

    JPEG is asked for as well, since USB 2 has no room for large pictures otherwise.

    Args:
        device: its number, or a path such as /dev/video2.
        size: width and height.
        frames_per_s: likewise.
    """
    level = cv2.utils.logging.getLogLevel()
    cv2.utils.logging.setLogLevel(cv2.utils.logging.LOG_LEVEL_SILENT)
    try:
        capture = cv2.VideoCapture(device)
    finally:
        cv2.utils.logging.setLogLevel(level)
    capture.set(cv2.CAP_PROP_FOURCC, cv2.VideoWriter.fourcc(*"MJPG"))
    capture.set(cv2.CAP_PROP_FRAME_WIDTH, size[0])
    capture.set(cv2.CAP_PROP_FRAME_HEIGHT, size[1])
    capture.set(cv2.CAP_PROP_FPS, frames_per_s)
    capture.set(cv2.CAP_PROP_BUFFERSIZE, 1)
    return capture
