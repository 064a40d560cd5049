"""Long runs are taken as several: runs are what splits, cross-fits and intervals are made of, and some drives are long.

A block begins like a run: what was commanded before it is not known, and no transition leads from one into the next, so
that neighbouring blocks share no measurement. Runs of many rows are cut for another reason as well: what is made of
rows takes many times their memory, and a block at a time is enough of them.
"""

import itertools
from collections.abc import Iterator, Sequence
from dataclasses import replace

import numpy as np

from swarmtwin.recordings.recording import Track
from swarmtwin.recordings.tables import RunTable

FEWEST_RUNS = 8
"""Of so many runs of a recording none is cut: a tenth of them is one at least."""

MOST_ROWS = 250_000
"""A run of more rows is cut as it is read, however many runs there are."""


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
    count = -(-blocks // max(1, len(runs)))
    return tuple(itertools.chain.from_iterable(_cut(own, min(count, max(map(len, own)) // shortest)) for own in runs))


def _cut(tracks: Sequence[Track], count: int) -> Iterator[Track]:
    """Yield the tracks of one run in `count` blocks of equal duration."""
    if count < 2:
        yield from tracks
        return
    seams_s = _seams(np.concatenate([track.time_s for track in tracks]), count)
    for block, track in itertools.product(range(count), tracks):
        rows = np.searchsorted(seams_s, track.time_s, side="right") == block
        if rows.any():
            name = _name(track.run, block, count)
            yield replace(
                track, run=name, time_s=track.time_s[rows], command=track.command[rows], pose=track.pose[rows]
            )


def table_in_blocks(
    run: str, table: RunTable, runs: int, *, blocks: int = 40, shortest: int = 40, most_rows: int = MOST_ROWS
) -> Iterator[tuple[str, RunTable]]:
    """Cut a run as it is read, before anything is made of its rows.

    Args:
        run: its name.
        table: its rows, which may be in no order; of a vehicle that goes back in time, it is left whole.
        runs: so many there are in the recording; of too few, it is cut as `in_blocks` does.
        blocks: as in `in_blocks`.
        shortest: as in `in_blocks`.
        most_rows: a run of more is cut in any case, so that a block has about so many at most.

    Yields:
        Names and rows of the blocks, of which at least one is not empty; a row without time is in the block of the same
        vehicle's row before it.
    """
    longest = int(np.bincount(table.vehicle, minlength=1).max())
    count = -(-len(table) // most_rows)
    if not enough_runs(runs):
        count = max(count, min(-(-blocks // max(1, runs)), longest // shortest))
    block = _block_of_rows(table, count) if count > 1 else None
    if block is None:
        yield run, table
        return
    order = np.argsort(block, kind="stable")
    edges = np.searchsorted(block[order], np.arange(count + 1))
    for number, (start, end) in enumerate(itertools.pairwise(edges.tolist())):
        if end > start:
            yield _name(run, number, count), table.at(order[start:end], truncated=table.truncated and end == len(table))


def _block_of_rows(table: RunTable, count: int, rows_at_a_time: int = 1_000_000) -> np.ndarray | None:
    """Return (R,) the block of each row; None where a vehicle goes back in time, or no row has one."""
    known = np.isfinite(table.time_s)
    if not known.any():
        return None
    block, seams_s = np.empty(len(table), np.int16), _seams(table.time_s[known], count)
    for first in range(0, len(table), rows_at_a_time):
        some = slice(first, first + rows_at_a_time)
        block[some] = np.searchsorted(seams_s, table.time_s[some], side="right")
    for vehicle in range(len(table.vehicles)):
        rows = np.flatnonzero(table.vehicle == vehicle) if len(table.vehicles) > 1 else slice(None)
        time_s, timeless = table.time_s[rows], ~known[rows]
        if timeless.any():
            block[rows] = np.maximum.accumulate(np.where(timeless, 0, block[rows]))
            time_s = time_s[~timeless]
        if (np.diff(time_s) < 0).any():
            return None
    return block


def _seams(time_s: np.ndarray, count: int) -> np.ndarray:
    """Return (count − 1,) the times at which blocks of equal duration end."""
    return np.linspace(time_s.min(), time_s.max(), count + 1)[1:-1]


def _name(run: str, block: int, count: int) -> str:
    return f"{run}~block{block + 1:0{max(2, len(str(count)))}}"


def run_of(name: str) -> str:
    """Return the name of the run that a block, or a whole run, comes from."""
    return name.partition("~block")[0]
