"""What controller, supervisor and live view tell each other at any moment: one small file, mapped into memory.

Every field is written by one side alone and read whole; nobody ever waits for anybody.
"""

import mmap
import struct
from enum import IntEnum, StrEnum
from pathlib import Path
from typing import Self


class Phase(IntEnum):
    """Where the controller is."""

    PREPARING = 0
    DRIVING = 1
    STOPPING = 2
    ENDED = 3


class LatchReason(StrEnum):
    """Why the supervisor has stopped the vehicles."""

    FROZE = "the controller froze"
    DIED = "the controller died"
    ASKED = "the controller asked for it"


class Heartbeat:
    """Signs of life, the supervisor's latch, and the red button.

    Attributes:
        path: of the file.
    """

    _FIELDS = (
        "controller_beat_s",
        "supervisor_beat_s",
        "phase",
        "supervisor_ready",
        "supervisor_connected",
        "latched_s",
        "latch_reason",
        "stop_requested",
        "ask_supervisor",
    )

    def __init__(self, path: Path, memory: mmap.mmap) -> None:
        self.path = path
        self._memory = memory

    @classmethod
    def create(cls, path: Path) -> Self:
        """Make the file, all zero."""
        path.write_bytes(bytes(8 * len(cls._FIELDS)))
        return cls.open(path)

    @classmethod
    def open(cls, path: Path) -> Self:
        """Map a file that another process has made."""
        with path.open("r+b") as file:
            return cls(path, mmap.mmap(file.fileno(), 8 * len(cls._FIELDS)))

    def read(self, field: str) -> float:
        """Return a field: a time on the monotonic clock, or a number; 0 where it was never written."""
        place = 8 * self._FIELDS.index(field)
        return float(struct.unpack("d", self._memory[place : place + 8])[0])

    def write(self, field: str, value: float) -> None:
        """Write a field."""
        place = 8 * self._FIELDS.index(field)
        self._memory[place : place + 8] = struct.pack("d", value)

    @property
    def phase(self) -> Phase:
        """Where the controller is."""
        return Phase(int(self.read("phase")))

    @phase.setter
    def phase(self, phase: Phase) -> None:
        self.write("phase", phase)

    @property
    def latched(self) -> str | None:
        """Why the supervisor has stopped the vehicles; None: it has not. Once it has, no controller drives again."""
        number = int(self.read("latch_reason"))
        return None if number == 0 else [*LatchReason][number - 1]

    def latch(self, reason: str, now_s: float) -> None:
        """Say for good that the vehicles are stopped."""
        if self.latched is None:
            self.write("latched_s", now_s)
            self.write("latch_reason", 1 + [*LatchReason].index(LatchReason(reason)))

    def close(self) -> None:
        """Let go of the memory."""
        self._memory.close()
