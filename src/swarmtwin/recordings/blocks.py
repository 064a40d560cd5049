"""Long runs are taken as several: runs are what splits, cross-fits and intervals are made of, and some drives are long.

A block begins like a run: what was commanded before it is not known, and no transition leads from one into the next, so
that neighbouring blocks share no measurement.
"""

import itertools
from collections.abc import Iterator, Sequence
from dataclasses import replace

import numpy as np

from swarmtwin.recordings.recording import Track

FEWEST_RUNS = 8
"""Of so many runs of a recording none is cut: a tenth of them is one at least."""


def enough_runs(count: int, fewest: int = FEWEST_RUNS) -> bool:
    """Whether a recording has so many runs that none of them is cut."""
    return count >= fewest


def in_blocks(
    tracks: Sequence[Track], *, fewest: int = FEWEST_RUNS, blocks: int = 40, shortest: int = 40
) -> tuple[Track, ...]:
    """Cut the runs of a recording that has too few of them; one that has enough stays as it is.

    Args:
        tracks: of the recording, in order of run.
        fewest: so many runs are enough.
        blocks: about how many there are to be in all: enough that a tenth of them is several.
        shortest: least periods in a block; a run that does not hold two such is not cut.

    Returns:
        tracks in order of run, block and vehicle. All vehicles of a run are cut at the same times.
    """
    runs = [list(own) for _, own in itertools.groupby(tracks, key=lambda track: track.run)]
    if enough_runs(len(runs), fewest):
        return tuple(tracks)
    return tuple(
        itertools.chain.from_iterable(one_in_blocks(own, len(runs), blocks=blocks, shortest=shortest) for own in runs)
    )


def one_in_blocks(tracks: Sequence[Track], runs: int, *, blocks: int = 40, shortest: int = 40) -> Iterator[Track]:
    """Cut one run of a recording that has so few `runs`; otherwise as `in_blocks`, which cuts all of them."""
    yield from _cut(tracks, min(-(-blocks // max(1, runs)), max(map(len, tracks)) // shortest))


def _cut(tracks: Sequence[Track], count: int) -> Iterator[Track]:
    """Yield the tracks of one run in `count` blocks of equal duration."""
    if count < 2:
        yield from tracks
        return
    began_s, ended_s = min(track.time_s[0] for track in tracks), max(track.time_s[-1] for track in tracks)
    seams_s = np.linspace(began_s, ended_s, count + 1)[1:-1]
    for block, track in itertools.product(range(count), tracks):
        rows = np.searchsorted(seams_s, track.time_s, side="right") == block
        if rows.any():
            name = f"{track.run}~block{block + 1:02}"
            yield replace(
                track, run=name, time_s=track.time_s[rows], command=track.command[rows], pose=track.pose[rows]
            )


def run_of(name: str) -> str:
    """Return the name of the run that a block, or a whole run, comes from."""
    return name.partition("~block")[0]
