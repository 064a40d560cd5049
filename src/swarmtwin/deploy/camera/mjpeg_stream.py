"""A camera that sends MJPEG over HTTP: most IP cameras, mjpg-streamer, ustreamer, and the emulated fleet's."""

import contextlib
import email.message
import threading
import time
from urllib.parse import urlsplit, urlunsplit

import cv2
import numpy as np
import requests
import urllib3.exceptions

from swarmtwin.deploy.camera.camera import CameraLostError, Frame
from swarmtwin.deploy.camera.multipart import MultipartReader, Part
from swarmtwin.deploy.camera.newest_picture import NewestPicture
from swarmtwin.deploy.camera.stamp_clock import StampClock
from swarmtwin.errors import UserError


class MjpegStream:
    """Reads the stream in a thread, and decodes the pictures that are asked for.

    A picture's time is its `X-Timestamp`, as `StampClock` understands it, or that of its arrival where it has none.
    A stream that breaks or falls silent is opened anew until the camera is closed.
    """

    is_live = True

    def __init__(self, address: str, patience_s: float = 3.0, silence_s: float = 2.0, pause_s: float = 0.1) -> None:
        """Open the stream and wait for its first picture.

        Args:
            address: http:// or https://, with user and password if the camera asks for them.
            patience_s: how long to wait for the first picture.
            silence_s: how long nothing may come before the stream is opened anew.
            pause_s: between two attempts.

        Raises:
            UserError: nobody answers there, or what answers is no MJPEG stream.
        """
        self.source = f"the camera {_without_password(address)}"
        self._address, self._silence_s, self._pause_s = address, silence_s, pause_s
        self._newest: NewestPicture[bytes] = NewestPicture(self.source)
        self._clock = StampClock()
        self._is_closed = threading.Event()
        self._session = requests.Session()
        self._session.trust_env = False
        self._response = self._connect(patience_s)
        self._thread = threading.Thread(target=self._read_for_ever, name=self.source, daemon=True)
        self._thread.start()
        try:
            first = self._newest.wait(-1, patience_s)
        except CameraLostError as lost:
            self.close()
            raise UserError(f"{lost}") from None
        picture = _decoded(first.content)
        if picture is None:
            self.close()
            raise UserError(f"{self.source} is no MJPEG stream: its parts are no JPEG pictures")
        self.size = picture.shape[1], picture.shape[0]

    def next_frame(self, after: int = -1, timeout_s: float = 1.0) -> Frame | None:
        """Return the newest picture whose number is greater than `after`, see `Camera`.

        Raises:
            CameraLostError: none came in time that could be read, or they have another size now.
        """
        end_s = time.monotonic() + timeout_s
        while True:
            arrival = self._newest.wait(after, max(0.0, end_s - time.monotonic()))
            picture = _decoded(arrival.content)
            if picture is not None:
                break
            after = arrival.number
            if time.monotonic() > end_s:
                raise CameraLostError(f"{self.source} has sent no whole picture for {timeout_s:g} s, but damaged ones")
        size = picture.shape[1], picture.shape[0]
        if size != self.size:
            raise CameraLostError(
                f"{self.source} sends pictures of {size[0]} x {size[1]} now, and of {self.size[0]} x {self.size[1]} at "
                "first: set it back, or begin anew"
            )
        return Frame(arrival.number, arrival.captured_s, picture)

    def close(self) -> None:
        """Let go of the stream."""
        self._is_closed.set()
        self._newest.close()
        self._stop_reading()
        self._thread.join(self._silence_s + 1.0)
        self._session.close()

    def _connect(self, timeout_s: float) -> requests.Response:
        """Return the answer with its content still to come.

        Raises:
            UserError: there is none, or it is no MJPEG stream.
        """
        try:
            response = self._session.get(self._address, stream=True, timeout=(timeout_s, timeout_s))
        except requests.exceptions.Timeout:
            raise UserError(f"{self.source} does not answer within {timeout_s:g} s: is it switched on?") from None
        except requests.exceptions.ConnectionError:
            raise UserError(f"{self.source} cannot be reached: is it on, and are host and port right?") from None
        except requests.exceptions.RequestException as error:
            raise UserError(f"{self.source} cannot be read: {error}") from None
        try:
            self._boundary = self._stream_boundary(response)
        except UserError:
            response.close()
            raise
        return response

    def _stream_boundary(self, response: requests.Response) -> str:
        if response.status_code in (401, 403):
            raise UserError(f"{self.source} asks for user and password: http://USER:PASSWORD@{_place(self._address)}")
        if response.status_code != 200:
            raise UserError(
                f"{self.source} answers {response.status_code} {response.reason}: what comes after the host must be "
                "the stream's path, such as /camera, /stream or /?action=stream"
            )
        header = email.message.Message()
        header["Content-Type"] = response.headers.get("Content-Type", "nothing")
        boundary = header.get_boundary()
        if header.get_content_maintype() == "multipart" and boundary and boundary.strip("-"):
            return boundary
        raise UserError(
            f"{self.source} is no MJPEG stream, but {header.get_content_type()}: give the stream's own address, not "
            "that of a page or of a single picture"
        )

    def _read_for_ever(self) -> None:
        while not self._is_closed.is_set():
            try:
                self._read_until_broken()
                self._newest.trouble("it ended the stream")
            except (urllib3.exceptions.HTTPError, OSError):
                self._newest.trouble("the connection broke or fell silent")
            self._response.close()
            self._reconnect()
        self._response.close()

    def _read_until_broken(self) -> None:
        reader = MultipartReader(self._boundary)
        while data := self._response.raw.read1(1 << 16):
            for part in reader.feed(data, time.monotonic()):
                self._newest.put(part.content, self._captured_s(part))

    def _captured_s(self, part: Part) -> float:
        return part.began_s if part.stamp_s is None else self._clock.captured_s(part.stamp_s, part.began_s)

    def _reconnect(self) -> None:
        while not self._is_closed.wait(self._pause_s):
            try:
                self._response = self._connect(self._silence_s)
                return
            except UserError as error:
                self._newest.trouble(str(error).removeprefix(f"{self.source} "))

    def _stop_reading(self) -> None:
        """Wake the thread that waits for the stream; to close the stream is the thread's part."""
        with contextlib.suppress(ValueError, OSError, RuntimeError):  # it may be closed already
            self._response.raw.shutdown()


def _decoded(content: bytes) -> np.ndarray | None:
    """Return a picture (H, W) or (H, W, 3); None: it is damaged."""
    end_of_image = b"\xff\xd9"
    if end_of_image not in content:
        return None
    try:
        return cv2.imdecode(np.frombuffer(content, np.uint8), cv2.IMREAD_ANYCOLOR | cv2.IMREAD_IGNORE_ORIENTATION)
    except cv2.error:
        return None


def _place(address: str) -> str:
    parts = urlsplit(address)
    return parts.netloc.rpartition("@")[2] + parts.path


def _without_password(address: str) -> str:
    parts = urlsplit(address)
    return urlunsplit(parts._replace(netloc=parts.netloc.rpartition("@")[2]))
