"""What was measured is recognised wherever it turns up: a simulation is not to be judged by what it was learned from.

A track is known by its digest, whatever the run is called and whichever file format holds it. But where a long run is
cut into blocks depends on how many runs its recording has, and of a drive that lies in another folder as well the
blocks are others. So of long runs some transitions are known too: those whose hash says so, however the run is cut.
"""

from collections.abc import Container, Sequence

import numpy as np
import pandas as pd

from swarmtwin.recordings.blocks import is_block, run_of
from swarmtwin.recordings.recording import Track

CUT_FROM = 80
"""A run of so many rows may be cut into blocks."""

ONE_IN = 16
"""Of so many transitions of a long run about one is known by itself."""


def marks(track: Track) -> tuple[str, ...]:
    """Return what a track is recognised by: its digest, and some of its transitions, if it is, or may be, cut."""
    if len(track) < CUT_FROM and not is_block(track.run):
        return (track.digest(),)
    return (track.digest(), *_marked_transitions(track))


def recognised(tracks: Sequence[Track], known: Container[str]) -> list[bool]:
    """Return which tracks of a recording are, or are parts of, those whose marks are known.

    Of a run that is cut otherwise than it had been, all blocks are: not each has a transition that is known.
    """
    all_marks = [marks(track) for track in tracks]
    cut_otherwise = {
        run_of(track.run)
        for track, (digest, *others) in zip(tracks, all_marks, strict=True)
        if digest not in known and any(one in known for one in others)
    }
    return [
        digest in known or run_of(track.run) in cut_otherwise
        for track, (digest, *_) in zip(tracks, all_marks, strict=True)
    ]


def row_hashes(*columns: np.ndarray) -> np.ndarray:
    """Return (N,) hashes of rows of finite numbers, (N,) or (N, K) each, which are the same to a thousandth."""
    thousandths = np.rint(1000 * np.column_stack(columns)).astype(np.int64)
    return pd.util.hash_pandas_object(pd.DataFrame(thousandths), index=False).to_numpy()


def _marked_transitions(track: Track) -> list[str]:
    """Return the hashes of some transitions of a vehicle that moved: of its time, command and both poses."""
    rows = np.column_stack([track.time_s[:-1], track.command[:-1], track.pose[:-1], track.pose[1:]])
    hashes = row_hashes(rows[np.isfinite(rows).all(axis=1) & (track.pose[:-1] != track.pose[1:]).any(axis=1)])
    return [f"{one:016x}" for one in hashes[hashes % ONE_IN == 0].tolist()]
