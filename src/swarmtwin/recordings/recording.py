"""What a recording is in memory: its header, and one track for each vehicle in each run."""

import hashlib
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Literal

import numpy as np

from swarmtwin.errors import UserError
from swarmtwin.robot import Arena, Robot, StrictModel

Check = Literal["clock", "commands", "still", "arena", "scale", "frame"]
"""What a recording as a whole is judged by: see `plausibility/`."""


Sent = Mapping[str, tuple[np.ndarray, np.ndarray]]
"""Commands as they were sent, by vehicle: times (K,) in s, strictly increasing, and commands (K, m)."""

SENT_FILE = "commands.parquet"
"""Beside a recording's header: every command at the time it was sent, where commands and poses are not synchronous."""


class Header(StrictModel):
    """The content of `recording.yaml`.

    Attributes:
        robot: name of the robot that was recorded.
        period_s: nominal control period.
        arena_mm: where the vehicles could move, in the frame of the poses.
        source: where the recording comes from, in words.
        vehicles: the ids that occur, if stated.
        started_at: date and time of the session, if stated.
        notes: anything else a person should know.
        accept: checks whose contradictions a person has looked at: they become warnings.
    """

    robot: str
    period_s: float
    arena_mm: Arena
    source: str
    vehicles: tuple[str, ...] | None = None
    started_at: str | None = None
    notes: str | None = None
    accept: tuple[Check, ...] | None = None


@dataclass(frozen=True)
class Track:
    """One vehicle's part of one run: T rows in order of time, each command held until the next row.

    Attributes:
        run: the run's name (its file's stem).
        vehicle: the vehicle's id.
        time_s: (T,), strictly increasing, seconds since the session began.
        command: (T, m) in the robot's units; a row of NaN where none was sent.
        pose: (T, 3) x_mm, y_mm, heading_rad in the arena's frame, heading in (−π, π]; a row of NaN where none was seen.
    """

    run: str
    vehicle: str
    time_s: np.ndarray
    command: np.ndarray
    pose: np.ndarray

    def __len__(self) -> int:
        return len(self.time_s)

    def digest(self) -> str:
        """Identify what was measured, whatever the run is called and whichever file format holds it."""
        content = hashlib.sha256(self.vehicle.encode())
        for values, decimals in ((self.time_s, 3), (self.command, 3), (self.pose, 3)):
            content.update((values.round(decimals) + 0.0).tobytes())
        return content.hexdigest()[:16]


@dataclass(frozen=True)
class Recording:
    """Measured runs of one robot.

    Attributes:
        robot: the robot, with its limits.
        header: the content of `recording.yaml`.
        tracks: in order of run, then vehicle.
        dropped_rows: rows set aside while reading, counted by reason.
        warnings: what is unusual of it as a whole and may be meant.
        digest: identifies the content of the runs, to tell one recording from another.
        sent: every command at the time it was sent, where commands and poses are not synchronous; None: tracks say all.
    """

    robot: Robot
    header: Header
    tracks: tuple[Track, ...]
    dropped_rows: Mapping[str, int] = field(default_factory=dict)
    digest: str = ""
    warnings: tuple[str, ...] = ()
    sent: Sent | None = None

    @property
    def runs(self) -> tuple[str, ...]:
        """Names of the runs, in order."""
        return tuple(dict.fromkeys(track.run for track in self.tracks))

    @property
    def vehicles(self) -> tuple[str, ...]:
        """Ids of the vehicles that occur, sorted."""
        return tuple(sorted({track.vehicle for track in self.tracks}))

    def where(self, chosen: Callable[[Track], bool]) -> "Recording":
        """Return the part of the recording whose tracks are `chosen`; its digest stays that of the whole."""
        return replace(self, tracks=tuple(track for track in self.tracks if chosen(track)))

    def without(self, left_out: Sequence[bool]) -> "Recording":
        """Return the recording without some tracks, of each of which it is said whether it is left out, in order."""
        kept = [track for track, is_out in zip(self.tracks, left_out, strict=True) if not is_out]
        return replace(self, tracks=tuple(kept))


def fault(file: Path, what: str, remedy: str, row: int | None = None, column: str | None = None) -> UserError:
    """Return the error for one fault. `row` counts from 1 as an editor shows it: a CSV file's header is row 1."""
    where = str(file)
    if row is not None:
        where += f", row {row}"
    if column is not None:
        where += f", column {column!r}"
    return UserError(f"{where}: {what}: {remedy}")
