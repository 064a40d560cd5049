"""What was measured is recognised wherever it turns up: a simulation is not to be judged by what it was learned from.

A track is known by its digest, whatever the run is called and whichever file format holds it. But where a long run is
cut into blocks depends on how many runs its recording has: a copy of one drive, in a folder of its own, is cut
elsewhere. So of long runs some transitions are known as well: those whose hash says so, however the run is cut.
"""

import base64
from collections import defaultdict
from collections.abc import Collection, Iterable, Sequence
from typing import NamedTuple

import numpy as np

from swarmtwin.errors import UserError
from swarmtwin.recordings.blocks import is_block, run_of
from swarmtwin.recordings.recording import Track

MARKED_FROM = 60
"""Runs of fewer rows are known as a whole alone: none is cut that has fewer than twice 40, duplicates among them."""

ONE_IN = 16
"""Of so many transitions of a long run about one is known: of a block of 40 rows two or three."""

MOST_TRANSITIONS = 100_000
"""So many transitions of a recording are kept, in half a megabyte: one in 16 of 1.6 million, of a longer one fewer."""

PACKED = "transitions:"
"""What the one mark begins with that holds the hashes of transitions, four bytes each, in base 64."""


class Marks(NamedTuple):
    """What a track is recognised by.

    Attributes:
        digest: of the whole.
        transitions: hashes of some of its transitions, of 32 bits; of a short run none.
    """

    digest: str
    transitions: np.ndarray


def marks(track: Track) -> Marks:
    """Return what a track is recognised by."""
    is_short = len(track) < MARKED_FROM and not is_block(track.run)
    return Marks(track.digest(), np.empty(0, np.uint32) if is_short else _marked_transitions(track))


def known_by(tracks: Iterable[Track]) -> tuple[str, ...]:
    """Return what tracks are recognised by, as a model's description keeps it: see `recognised`."""
    return kept_marks(map(marks, tracks))


def kept_marks(of_tracks: Iterable[Marks]) -> tuple[str, ...]:
    """Return the marks of tracks, sorted, as a model's description keeps them: see `recognised`."""
    of_tracks = list(of_tracks)
    hashes = np.unique(np.concatenate([np.empty(0, np.uint32), *(own.transitions for own in of_tracks)]))
    packed = base64.b64encode(hashes[:MOST_TRANSITIONS].astype("<u4").tobytes()).decode()
    return tuple(sorted({*(own.digest for own in of_tracks), *([PACKED + packed] if packed else [])}))


def recognised(tracks: Sequence[Track], known: Collection[str]) -> list[bool]:
    """Return which tracks of a recording are, or are parts of, those that `known_by` was made of.

    Of a long run that was cut elsewhere more than half of the transitions that can be known have to be, and of a block
    all, if three can: runs of which only the beginning is the same are others.

    Raises:
        UserError: what is known is damaged.
    """
    of_tracks = [marks(track) for track in tracks]
    is_whole = [own.digest in known for own in of_tracks]
    transitions = np.concatenate([np.empty(0, np.uint32), *map(_unpacked, known)])
    found = [np.isin(own.transitions, transitions) for own in of_tracks]
    runs = [(run_of(track.run), track.vehicle) for track in tracks]
    cut_alike = {run for run, known_whole in zip(runs, is_whole, strict=True) if known_whole}
    of_runs: dict[tuple[str, str], list[bool]] = defaultdict(list)
    for run, own in zip(runs, found, strict=True):
        of_runs[run] += own.tolist()
    cut_otherwise = {run for run, own in of_runs.items() if run not in cut_alike and sum(own) > max(1, len(own) / 2)}
    return [
        whole or run in cut_otherwise or (len(own) >= 3 and bool(own.all()))
        for whole, run, own in zip(is_whole, runs, found, strict=True)
    ]


def row_hashes(*columns: np.ndarray) -> np.ndarray:
    """Return (N,) hashes of rows of finite numbers, (N,) or (N, K) each, which are the same to a thousandth.

    They are those that pandas gives a table of whole numbers, at a tenth of the time where tables are short.
    """
    mixed = _mixed(np.rint(1000 * np.column_stack(columns)).astype(np.int64).astype(np.uint64)).T
    hashes, factor = np.full(mixed.shape[1], 0x345678, np.uint64), 1_000_003
    for left, column in zip(range(len(mixed), 0, -1), mixed, strict=True):
        hashes = (hashes ^ column) * np.uint64(factor)
        factor += 82_520 + 2 * left
    return hashes + np.uint64(97_531)


def _mixed(values: np.ndarray) -> np.ndarray:
    """Return numbers of 64 bits, each bit of which hangs on each of the given one's (SplitMix64: Steele, 2014)."""
    values = (values ^ (values >> np.uint64(30))) * np.uint64(0xBF58476D1CE4E5B9)
    values = (values ^ (values >> np.uint64(27))) * np.uint64(0x94D049BB133111EB)
    return values ^ (values >> np.uint64(31))


def _marked_transitions(track: Track) -> np.ndarray:
    """Return the hashes of some transitions of a vehicle that moved: of its time, command and both poses."""
    rows = np.column_stack([track.time_s[:-1], track.command[:-1], track.pose[:-1], track.pose[1:]])
    hashes = row_hashes(rows[np.isfinite(rows).all(axis=1) & (track.pose[:-1] != track.pose[1:]).any(axis=1)])
    return (hashes[hashes % ONE_IN == 0] >> 32).astype(np.uint32)


def _unpacked(mark: str) -> np.ndarray:
    """Return the hashes of transitions that a mark holds; a digest holds none."""
    if not mark.startswith(PACKED):
        return np.empty(0, np.uint32)
    try:
        return np.frombuffer(base64.b64decode(mark.removeprefix(PACKED), validate=True), "<u4")
    except ValueError as error:
        raise UserError(
            f"what a simulation was learned from cannot be read: its description is damaged at {mark[:24]!r}… "
            f"({error}): train it anew"
        ) from None
