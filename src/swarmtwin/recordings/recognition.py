"""What was measured is recognised wherever it turns up: a simulation is not to be judged by what it was learned from.

A track is known by its digest, whatever the run is called. But where a long run is cut into blocks depends on how many
runs its recording has: a copy of one drive, in a folder of its own, is cut elsewhere. And a format that holds fewer
digits rounds a number here and there another way. So some transitions are known as well: those whose hash says so.
"""

import base64
import itertools
from collections import defaultdict
from collections.abc import Collection, Iterable, Sequence
from typing import NamedTuple

import numpy as np

from swarmtwin.errors import UserError
from swarmtwin.recordings.blocks import run_of
from swarmtwin.recordings.recording import Track

ONE_IN = 4
"""Of so many transitions about one can be known: of a run or block of 40 rows ten."""

MOST_TRANSITIONS = 100_000
"""So many transitions of a recording are kept, in half a megabyte: one in 4 of 400,000, of a longer one fewer."""

AROUND = 40
"""So many transitions that can be known say whether a part of a run is known: of 160 rows, where all are kept."""

PACKED = "transitions:"
"""What the one mark begins with that holds the hashes of transitions, four bytes each, in base 64."""


class Marks(NamedTuple):
    """What a track is recognised by.

    Attributes:
        digest: of the whole.
        transitions: hashes of some of its transitions, of 32 bits, in order of time.
    """

    digest: str
    transitions: np.ndarray


def marks(track: Track) -> Marks:
    """Return what a track is recognised by."""
    return Marks(track.digest(), _marked_transitions(track))


def known_by(tracks: Iterable[Track]) -> tuple[str, ...]:
    """Return what tracks are recognised by, as a model's description keeps it: see `recognised`."""
    return kept_marks(map(marks, tracks))


def kept_marks(of_tracks: Iterable[Marks]) -> tuple[str, ...]:
    """Return the marks of tracks, sorted, as a model's description keeps them: see `recognised`."""
    of_tracks = list(of_tracks)
    hashes = np.unique(np.concatenate([np.empty(0, np.uint32), *(own.transitions for own in of_tracks)]))
    packed = base64.b64encode(hashes[:MOST_TRANSITIONS].astype("<u4").tobytes()).decode()
    return tuple(sorted({*(own.digest for own in of_tracks), *([PACKED + packed] if packed else [])}))


def digests(known: Iterable[str]) -> set[str]:
    """Return the digests of whole tracks among what tracks are recognised by."""
    return {mark for mark in known if not mark.startswith(PACKED)}


def recognised(tracks: Sequence[Track], known: Collection[str]) -> list[bool]:
    """Return which tracks of a recording are, or are parts of, those that `known_by` was made of.

    Where no block of a run is known by its digest, the run was cut otherwise, and more than half of the transitions
    that can be known have to be, of a track and what was driven before and after it (`AROUND`): runs of which only the
    beginning is the same are others. A vehicle that never moves is known with those that did in the same run.

    Raises:
        UserError: what is known is damaged.
    """
    of_tracks = [marks(track) for track in tracks]
    found = [own.digest in known for own in of_tracks]
    runs: dict[tuple[str, str], list[int]] = defaultdict(list)
    for number, track in enumerate(tracks):
        runs[run_of(track.run), track.vehicle].append(number)
    cut_otherwise = [own for own in runs.values() if not any(found[number] for number in own)]
    together = np.concatenate([np.empty(0, np.uint32), *(own.transitions for own in of_tracks)])
    ends = np.cumsum([len(own.transitions) for own in of_tracks], dtype=int)
    for kept in (_unpacked(mark) for mark in known if mark.startswith(PACKED)):
        of_each = np.split(_told(together, kept), ends[:-1])
        for own in cut_otherwise:
            for number, is_part in zip(own, _known_parts([of_each[number] for number in own]), strict=True):
                found[number] |= is_part
    moved = {tracks[number].run for own in cut_otherwise for number in own if found[number]}
    for own in cut_otherwise:
        if not any(len(of_tracks[number].transitions) for number in own):
            for number in own:
                found[number] = tracks[number].run in moved
    return found


def _told(hashes: np.ndarray, kept: np.ndarray) -> np.ndarray:
    """Return (M,) 1 where hashes (M,) are among those that were kept, 0 where not, −1 where they cannot be known."""
    last = kept.max() if len(kept) >= MOST_TRANSITIONS else np.iinfo(np.uint32).max
    return np.where(hashes > last, -1, np.isin(hashes, kept).astype(np.int8))


def _known_parts(told: Sequence[np.ndarray]) -> list[bool]:
    """Return which parts of a run are known, by what `_told` says of their transitions, part after part."""
    can_be_known = [part[part >= 0] for part in told]
    together, edges = np.concatenate(can_be_known), np.cumsum([0, *map(len, can_be_known)])
    known = []
    for start, end in itertools.pairwise(edges.tolist()):
        first = max(min(start - (AROUND - (end - start)) // 2, len(together) - AROUND, start), 0)
        around = together[first : max(first + AROUND, end)]
        known.append(int(around.sum()) > max(1, len(around) / 2))
    return known


def row_hashes(*columns: np.ndarray) -> np.ndarray:
    """Return (N,) hashes of rows of numbers below 10¹², (N,) or (N, K) each, which are the same to a thousandth.

    Files hold decimal numbers, of which many lie half-way between two thousandths: what is rounded is a little more, so
    that these are rounded alike however they are held.
    """
    numbers = np.rint(1000 * np.column_stack(columns) + 0.0037).astype(np.int64).view(np.uint64)
    by_column = _mixed(numbers + _GOLDEN * np.arange(1, numbers.shape[1] + 1, dtype=np.uint64))
    return _mixed(by_column.sum(axis=1, dtype=np.uint64))


_GOLDEN = np.uint64(0x9E3779B97F4A7C15)
"""By which numbers of neighbouring columns differ before they are mixed, of SplitMix64."""


def _mixed(values: np.ndarray) -> np.ndarray:
    """Return numbers of 64 bits, each bit of which hangs on each of the given one's (SplitMix64: Steele, 2014)."""
    values = (values ^ (values >> np.uint64(30))) * np.uint64(0xBF58476D1CE4E5B9)
    values = (values ^ (values >> np.uint64(27))) * np.uint64(0x94D049BB133111EB)
    return values ^ (values >> np.uint64(31))


def _marked_transitions(track: Track) -> np.ndarray:
    """Return the hashes of some transitions of a vehicle that moved: of its time, command and both poses."""
    rows = np.column_stack([track.time_s[:-1], track.command[:-1], track.pose[:-1], track.pose[1:]])
    is_known = (np.abs(rows) < 1e12).all(axis=1)
    hashes = row_hashes(rows[is_known & (track.pose[:-1] != track.pose[1:]).any(axis=1)])
    return (hashes[hashes % ONE_IN == 0] >> 32).astype(np.uint32)


def _unpacked(mark: str) -> np.ndarray:
    """Return the hashes of transitions that a mark holds."""
    try:
        return np.frombuffer(base64.b64decode(mark.removeprefix(PACKED), validate=True), "<u4")
    except ValueError as error:
        raise UserError(
            f"what a simulation was learned from cannot be read: its description is damaged at {mark[:24]!r}… "
            f"({error}): train it anew"
        ) from None
