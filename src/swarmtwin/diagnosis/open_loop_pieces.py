"""Step 4. Pieces of held-out runs, each predicted in open loop from a measured pose: over periods, or over seconds."""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace

import numpy as np

from swarmtwin.recordings.recording import Track
from swarmtwin.simulation.open_loop import open_loop
from swarmtwin.simulation.simulation import Simulation


@dataclass(frozen=True)
class WindowErrors:
    """How much a simulation errs in open loop over windows of one length.

    Attributes:
        window_s: the length.
        rmse_mm: (P,) root mean square distance between predicted and measured positions, window by window; NaN where
            none is known.
        run: of each window.
    """

    window_s: float
    rmse_mm: np.ndarray
    run: tuple[str, ...]


def window_errors(
    simulation: Simulation, tracks: Sequence[Track], windows_s: Sequence[float]
) -> tuple[WindowErrors, ...]:
    """Predict windows of tracks, of each length, in open loop, all at once."""
    cut = [[(track.run, piece) for track in tracks for piece in pieces_over(track, one)] for one in windows_s]
    loops = iter(open_loop(simulation, [piece for parts in cut for _, piece in parts]))
    return tuple(
        WindowErrors(window_s, np.array([next(loops).rmse_mm for _ in parts]), tuple(run for run, _ in parts))
        for window_s, parts in zip(windows_s, cut, strict=True)
    )


def pieces(track: Track, periods: int = 10) -> Iterator[Track]:
    """Yield pieces of a track, each so many periods from a known pose on, one after the other.

    Each begins one row earlier, without its pose, so that the command before is known. They are runs of their own.
    """
    known = np.flatnonzero(_is_known(track))
    begins = known[:1]
    while len(begins) and begins[0] + 1 < len(track):
        first = int(begins[0])
        yield _piece(track, first, first + periods, f"{track.run}, period {first // periods}")
        begins = known[known >= first + periods][:1]


def pieces_over(track: Track, window_s: float) -> Iterator[Track]:
    """Yield pieces of a track likewise, each to the last row within `window_s` of its pose.

    In each stretch of that length one begins at the first known pose, so that those of several vehicles begin together
    even where poses are missing. A run ends no earlier than its last piece: a shorter one has none.
    """
    since_s = np.round(track.time_s - track.time_s[0], 6)
    ends_s = np.round(since_s + window_s, 6)
    begins = np.flatnonzero(_is_known(track) & (ends_s <= since_s[-1]))
    stretch, first = np.unique(np.floor(np.round(since_s[begins] / window_s, 6)), return_index=True)
    for number, begin in zip(stretch, begins[first], strict=True):
        last = int(np.searchsorted(since_s, ends_s[begin], side="right")) - 1
        yield _piece(track, int(begin), last, f"{track.run}, {window_s:g} s, {number:.0f}")


def _is_known(track: Track) -> np.ndarray:
    """Return (T,) whether the pose of each row is known."""
    known: np.ndarray = np.isfinite(track.pose).all(axis=1)
    return known


def _piece(track: Track, first: int, last: int, name: str) -> Track:
    """Return the rows from the one before `first` to `last` as a run of its own; its first known pose is at `first`."""
    rows = slice(max(first - 1, 0), last + 1)
    pose = track.pose[rows].copy()
    pose[: first - rows.start] = np.nan
    return replace(track, run=name, time_s=track.time_s[rows], command=track.command[rows], pose=pose)
