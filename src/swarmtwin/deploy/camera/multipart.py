"""The pictures in a stream of multipart/x-mixed-replace, whatever way it is cut into pieces."""

import math
import re
from collections.abc import Iterator
from dataclasses import dataclass


@dataclass(frozen=True)
class Part:
    """One part of the stream.

    Attributes:
        content: its bytes.
        began_s: when its header was read.
        stamp_s: its X-Timestamp, on the sender's clock; None: it has none that is a number.
    """

    content: bytes
    began_s: float
    stamp_s: float | None


class MultipartReader:
    """Cuts what comes into parts; after garbage it goes on at the next boundary."""

    def __init__(self, boundary: str, largest_bytes: int = 1 << 25, largest_header_bytes: int = 1 << 13) -> None:
        """Wait for the first boundary.

        Args:
            boundary: as the stream's Content-Type states it. Hyphens round it are ignored: senders disagree on them.
            largest_bytes: a longer part is garbage.
            largest_header_bytes: likewise.
        """
        self._boundary = b"--" + boundary.strip("-").encode("latin-1")
        self._largest, self._largest_header = largest_bytes, largest_header_bytes
        self._rest = bytearray()
        self._header: tuple[float, float | None, int | None] | None = None
        self._searched = 0

    def feed(self, data: bytes, read_s: float) -> Iterator[Part]:
        """Take what was read at a time, and yield the parts that are whole now."""
        self._rest += data
        while True:
            if self._header is None and not self._read_header(read_s):
                return
            part = self._read_content()
            if part is None:
                return
            yield part

    def _read_header(self, read_s: float) -> bool:
        while True:
            begin = self._rest.find(self._boundary)
            if begin < 0:
                del self._rest[: max(0, len(self._rest) - len(self._boundary) + 1)]
                return False
            del self._rest[:begin]
            end = re.compile(rb"\r?\n\r?\n").search(self._rest, 0, self._largest_header)
            if end:
                fields = _fields(bytes(self._rest[: end.start()]))
                self._header = read_s, _stamp_s(fields), self._length(fields)
                self._searched = 0
                del self._rest[: end.end()]
                return True
            if len(self._rest) < self._largest_header:
                return False
            del self._rest[: len(self._boundary)]

    def _read_content(self) -> Part | None:
        """Return the part whose header was read; None: it is not whole, or was garbage."""
        assert self._header is not None
        began_s, stamp_s, length = self._header
        end = length if length is not None else self._rest.find(self._boundary, self._searched)
        if end < 0 or end > len(self._rest):
            self._searched = max(0, len(self._rest) - len(self._boundary))
            if len(self._rest) > self._largest:
                self._header = None
            return None
        content = bytes(self._rest[:end])
        del self._rest[:end]
        self._header = None
        return Part(content, began_s, stamp_s)

    def _length(self, fields: dict[str, str]) -> int | None:
        stated = fields.get("content-length", "")
        return int(stated) if re.fullmatch("[0-9]{1,12}", stated) and int(stated) <= self._largest else None


def _fields(header: bytes) -> dict[str, str]:
    lines = header.decode("latin-1").splitlines()[1:]
    return {
        name.strip().lower(): value.strip() for name, colon, value in (line.partition(":") for line in lines) if colon
    }


def _stamp_s(fields: dict[str, str]) -> float | None:
    try:
        stamp_s = float(fields.get("x-timestamp", ""))
    except ValueError:
        return None
    return stamp_s if math.isfinite(stamp_s) else None
