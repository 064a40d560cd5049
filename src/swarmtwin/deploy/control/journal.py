"""What happened, written as it happens: one JSON a line, on space that was reserved before anything moved."""

import json
import os
import threading
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

import numpy as np

from swarmtwin.deploy.tracking.sighting import Sighting
from swarmtwin.errors import RefusedError, UserError

JOURNAL = "journal.jsonl"


class JournalError(RefusedError):
    """The journal cannot be written: nobody could say any more what the vehicles were told."""


class Journal:
    """A file to which lines are added, by any thread; each is with the system before `write` returns.

    So a kill of the process loses nothing of it. What is reserved and not yet written reads as zero bytes.

    Attributes:
        path: of the file.
    """

    def __init__(self, path: Path, reserved_bytes: int) -> None:
        """Make the file and reserve its space.

        Raises:
            UserError: there is not so much space.
        """
        self.path = path
        self._lock = threading.Lock()
        self._place = 0
        self._reserved_bytes = reserved_bytes
        self._descriptor = os.open(path, os.O_RDWR | os.O_CREAT | os.O_EXCL, 0o666)
        try:
            os.posix_fallocate(self._descriptor, 0, reserved_bytes)
        except OSError as error:
            os.close(self._descriptor)
            path.unlink()
            raise UserError(
                f"no room for the recording, {reserved_bytes / 2**20:.1f} MiB in {path.parent}: {error.strerror}; "
                "make room, or choose another output"
            ) from None

    def write(self, kind: str, **content: Any) -> None:
        """Add a line.

        Raises:
            JournalError: it cannot be written.
        """
        line = json.dumps({"kind": kind, **content}, default=_plain, separators=(",", ":")).encode() + b"\n"
        with self._lock:
            try:
                written = os.pwrite(self._descriptor, line, self._place)
            except OSError as error:
                raise JournalError(f"{self.path} cannot be written: {error.strerror}") from None
            if written < len(line):
                raise JournalError(f"{self.path} cannot be written: the disk is full")
            self._place += len(line)

    def sighting(self, sighting: Sighting) -> None:
        """Add what one picture showed.

        Raises:
            JournalError: it cannot be written.
        """
        poses = {vehicle: np.round(pose, 5) for vehicle, pose in sighting.poses.items()}
        doubts = {"doubts": dict(sighting.doubts)} if sighting.doubts else {}
        self.write("sighting", number=sighting.number, captured_s=round(sighting.captured_s, 6), poses=poses, **doubts)

    def close(self) -> None:
        """Give back the space that was not needed."""
        with self._lock:
            if self._descriptor >= 0:
                os.ftruncate(self._descriptor, self._place)
                os.close(self._descriptor)
                self._descriptor = -1


def reserved_bytes(vehicles: int, periods: int, pictures: int) -> int:
    """Return how much space a journal needs at most, with half as much again."""
    line, vehicle, seen = 400, 700, 80
    return int(1.5 * (periods * (line + vehicles * vehicle) + pictures * (line + vehicles * seen))) + 2**16


def read_journal(path: Path) -> Iterator[Mapping[str, Any]]:
    """Give the lines of a journal in order, also of one whose process was killed: it ends where its lines do.

    Raises:
        UserError: there is none.
    """
    try:
        content = path.read_bytes()
    except OSError as error:
        raise UserError(f"no journal at {path}: {error.strerror}") from None
    end = content.find(b"\0")
    for line in content[: end if end >= 0 else len(content)].split(b"\n")[:-1]:
        yield json.loads(line)


def _plain(value: Any) -> Any:
    if isinstance(value, np.ndarray):
        return value.tolist()
    if isinstance(value, np.generic):
        return value.item()
    return str(value)
