"""Several recordings of one robot as one: what a reference of several vehicles is made of."""

import hashlib
from collections import Counter
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path

from swarmtwin.errors import UserError
from swarmtwin.recordings.recording import Recording


def joined(recordings: Mapping[Path, Recording]) -> Recording:
    """Return recordings, by their folders, as one; a single one as it is.

    Its runs are called by their folder's name as well. Each keeps its own clock; commands are those in the tracks, not
    the logs of when each was sent. A vehicle whose id is in several of them is taken for one and the same, and a
    warning says so.

    Raises:
        UserError: they differ in robot, arena or nominal period, or one is given twice.
    """
    (first_folder, first), *others = recordings.items()
    if not others:
        return first
    for folder, other in others:
        for what in ("robot", "period_s", "arena_mm"):
            one, another = getattr(first.header, what), getattr(other.header, what)
            if one != another:
                raise UserError(
                    f"{folder} is a recording with {what} {_words(another)}, and {first_folder} one with "
                    f"{_words(one)}: give recordings of one robot in one arena, made with one period"
                )
    known: dict[str, Path] = {}
    for folder, recording in recordings.items():
        if recording.digest and known.setdefault(recording.digest, folder) is not folder:
            raise UserError(f"{folder} and {known[recording.digest]} are the same recording: give it once")
    warnings = [warning for one in recordings.values() for warning in one.warnings]
    driven: dict[str, list[str]] = {}
    for folder, recording in recordings.items():
        for vehicle in recording.vehicles:
            driven.setdefault(vehicle, []).append(str(folder))
    for vehicle, folders in driven.items():
        if len(folders) > 1:
            warnings.append(
                f"vehicle {vehicle!r} of {' and '.join(folders)} is taken for one and the same: record each vehicle "
                "under an id of its own, vehicle=2, if it is not"
            )
    names = [folder.resolve().name for folder in recordings]
    if len(set(names)) < len(names):
        names = [f"{number}_{name}" for number, name in enumerate(names, start=1)]
    tracks = [
        replace(track, run=f"{name}_{track.run}")
        for name, recording in zip(names, recordings.values(), strict=True)
        for track in recording.tracks
    ]
    digests = "".join(one.digest for one in recordings.values())
    dropped = sum((Counter(one.dropped_rows) for one in recordings.values()), Counter[str]())
    return Recording(
        robot=first.robot,
        header=first.header.model_copy(update={"vehicles": None, "started_at": None, "notes": None}),
        tracks=tuple(tracks),
        dropped_rows=dict(dropped),
        digest=hashlib.sha256(digests.encode()).hexdigest()[:16],
        warnings=tuple(warnings),
    )


def _words(value: object) -> str:
    dumped = getattr(value, "model_dump", None)
    return str(dumped(mode="json") if dumped else value)
