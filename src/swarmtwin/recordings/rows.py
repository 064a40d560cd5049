"""All rows of some tracks in one set of arrays, so that every check is one array operation."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Self

import numpy as np

from swarmtwin.recordings.recording import Track


@dataclass(frozen=True)
class Rows:
    """The R rows of all tracks, one track after the other.

    Attributes:
        track: (R,) index of the track.
        run: (R,) index into `runs`.
        vehicle: (R,) index into `vehicles`.
        time_s: (R,).
        command: (R, m), a row of NaN where there was none.
        pose: (R, 3), a row of NaN where there was none.
        runs: names of the tracks' runs, in order.
        vehicles: ids of the tracks' vehicles, sorted.
    """

    track: np.ndarray
    run: np.ndarray
    vehicle: np.ndarray
    time_s: np.ndarray
    command: np.ndarray
    pose: np.ndarray
    runs: tuple[str, ...]
    vehicles: tuple[str, ...]

    @classmethod
    def of(cls, tracks: Sequence[Track]) -> Self:
        """Join tracks, at least one."""
        runs = {run: index for index, run in enumerate(dict.fromkeys(track.run for track in tracks))}
        vehicles = {vehicle: index for index, vehicle in enumerate(sorted({track.vehicle for track in tracks}))}
        lengths = [len(track) for track in tracks]
        return cls(
            track=np.repeat(np.arange(len(tracks)), lengths),
            run=np.repeat([runs[track.run] for track in tracks], lengths),
            vehicle=np.repeat([vehicles[track.vehicle] for track in tracks], lengths),
            time_s=np.concatenate([track.time_s for track in tracks]),
            command=np.concatenate([track.command for track in tracks]),
            pose=np.concatenate([track.pose for track in tracks]),
            runs=tuple(runs),
            vehicles=tuple(vehicles),
        )

    def __len__(self) -> int:
        return len(self.time_s)

    def starts(self) -> np.ndarray:
        """Return (P,) the rows that a row of the same track follows."""
        return np.flatnonzero(self.track[1:] == self.track[:-1])


def at_most(duration_s: np.ndarray | float, limit_s: np.ndarray | float, rounding_s: float = 1e-6) -> np.ndarray:
    """Return whether durations reach no further than a limit.

    Args:
        duration_s: any shape.
        limit_s: broadcasting to it.
        rounding_s: by how much a sum or difference of times may be off; times themselves are written to 1 ms.
    """
    within: np.ndarray = np.less_equal(duration_s, limit_s + rounding_s)
    return within
