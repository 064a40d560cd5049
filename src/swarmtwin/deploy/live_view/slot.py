"""A place in shared memory for the newest of something: written without ever waiting, read whole or not at all."""

import mmap
import struct
from pathlib import Path
from typing import Self


class Slot:
    """One content at a time; a newer one replaces it whether anybody has read it or not (a sequence lock).

    Attributes:
        path: of the file that is mapped.
    """

    _HEADER = struct.Struct("QQ")  # a number that is odd while somebody writes, and the content's length

    def __init__(self, path: Path, memory: mmap.mmap) -> None:
        self.path = path
        self._memory = memory

    @classmethod
    def create(cls, path: Path, largest_bytes: int) -> Self:
        """Make a slot for contents of so many bytes at most."""
        with path.open("wb") as file:
            file.truncate(cls._HEADER.size + largest_bytes)
        return cls.open(path)

    @classmethod
    def open(cls, path: Path) -> Self:
        """Map a slot that another process has made."""
        with path.open("r+b") as file:
            return cls(path, mmap.mmap(file.fileno(), 0))

    def write(self, *parts: bytes | memoryview) -> bool:
        """Replace the content by `parts` joined; return False, and leave it, where they are too long."""
        start = self._HEADER.size
        length = sum(len(part) for part in parts)
        if start + length > len(self._memory):
            return False
        number, _ = self._HEADER.unpack_from(self._memory)
        self._HEADER.pack_into(self._memory, 0, number + 1, length)
        for part in parts:
            self._memory[start : start + len(part)] = part
            start += len(part)
        self._HEADER.pack_into(self._memory, 0, number + 2, length)
        return True

    def read(self, unless: int = -1, tries: int = 5) -> tuple[int, bytes] | None:
        """Return the content with its number; None where there is none, the number is `unless`, or it changes."""
        for _ in range(tries):
            number, length = self._HEADER.unpack_from(self._memory)
            if number == 0 or number == unless:
                return None
            if number % 2 == 0:
                content = bytes(self._memory[self._HEADER.size : self._HEADER.size + length])
                if self._HEADER.unpack_from(self._memory)[0] == number:
                    return number, content
        return None
