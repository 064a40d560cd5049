"""A video as a camera: every picture in its order, at the time that the file states."""

from collections.abc import Iterator
from pathlib import Path

import av
import av.error

from swarmtwin.deploy.camera.camera import Frame
from swarmtwin.errors import UserError


class VideoFile:
    """Plays a video as fast as it is asked for; times are seconds since its first picture."""

    is_live = False

    def __init__(self, path: Path) -> None:
        """Open the file.

        Raises:
            UserError: it is no video.
        """
        self.source = f"the video {path}"
        try:
            self._file = av.open(str(path))
        except (av.error.FFmpegError, OSError) as error:
            raise UserError(
                f"{path} is no video that can be read ({_reason(error)}): give MP4, MKV, AVI or MOV"
            ) from None
        if not self._file.streams.video:
            self._file.close()
            raise UserError(f"{path} has no pictures in it: give a video")
        self._stream = self._file.streams.video[0]
        self._stream.thread_type = "AUTO"
        self.size = self._stream.codec_context.width, self._stream.codec_context.height
        self._frames = self._decode()

    def next_frame(self, after: int = -1, timeout_s: float = 1.0) -> Frame | None:
        """Return the next picture whose number is greater than `after`; None: the video has ended.

        Raises:
            UserError: the file is damaged, or its pictures' size changes.
        """
        return next((frame for frame in self._frames if frame.number > after), None)

    def close(self) -> None:
        """Close the file."""
        self._frames = iter(())
        self._file.close()

    def _decode(self) -> Iterator[Frame]:
        first_s: float | None = None
        time_s = 0.0
        frames = self._file.decode(self._stream)
        rate = float(self._stream.average_rate or 25)
        number = 0
        while True:
            try:
                picture = next(frames, None)
            except av.error.FFmpegError as error:
                raise UserError(
                    f"{self.source} is damaged {time_s:.2f} s after its beginning: {_reason(error)}"
                ) from None
            if picture is None:
                return
            shown_s = picture.time
            first_s = shown_s if first_s is None else first_s
            time_s = shown_s - first_s if shown_s is not None and first_s is not None else number / rate
            if (picture.width, picture.height) != self.size:
                raise UserError(f"{self.source}: the pictures' size changes after {time_s:.2f} s: cut it there")
            yield Frame(number, time_s, picture.to_ndarray(format="gray"))
            number += 1


def _reason(error: Exception) -> str:
    return getattr(error, "strerror", None) or str(error)
