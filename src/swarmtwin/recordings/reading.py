"""Reading a recording: its header, its runs, and everything a camera and a network get wrong in them."""

import datetime
import hashlib
import itertools
import logging
import math
from collections import Counter
from collections.abc import Iterator, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import yaml

from swarmtwin.errors import UserError
from swarmtwin.files import check_regular
from swarmtwin.plain_yaml import read_yaml
from swarmtwin.recordings.blocks import in_blocks
from swarmtwin.recordings.plausibility.judgement import judge
from swarmtwin.recordings.recording import SENT_FILE, Header, Recording, Sent, Track, fault
from swarmtwin.recordings.tables import RunTable, parse_run, parse_runs_together
from swarmtwin.recordings.tracks import tracks_of
from swarmtwin.robot import Robot

HEADER_FILE = "recording.yaml"
RUNS_FOLDER = "runs"
RUNS_FILE = "runs.parquet"
RUN_SUFFIXES = (".csv", ".parquet")

logger = logging.getLogger(__name__)


def read_recording(folder: Path, robot: Robot) -> Recording:
    """Read the recording of `robot` in `folder`, and judge it as a whole. Nothing in it is modified.

    Where there are few runs, long ones are cut into blocks, which count as runs from here on: see `in_blocks`.

    Faults of single rows are counted in `Recording.dropped_rows` and logged in one line; what is unusual of the whole
    is in `Recording.warnings`, and logged.

    Raises:
        UserError: for a fault of a file, naming the file, the row, the column and the remedy; or the recording as a
            whole cannot be what it says.
    """
    folder = Path(folder)
    header, files = look_into(folder, robot)
    _log_others(folder / RUNS_FOLDER)
    tracks: list[Track] = []
    in_degrees: list[Track] = []
    beyond_a_turn = False
    dropped: Counter[str] = Counter()
    unread: dict[str, None] = {}
    digest = hashlib.sha256()
    for run, table in _run_tables(files, robot, digest):
        unread |= dict.fromkeys(table.unread)
        run_tracks, run_dropped = tracks_of(table, run, header.vehicles)
        tracks += run_tracks
        dropped += run_dropped
        beyond_a_turn |= bool(np.any(np.abs(table.pose[:, 2]) > 2 * np.pi))
        if beyond_a_turn:
            in_degrees += tracks_of(table.with_headings_in_degrees(), run, header.vehicles)[0]
    if not tracks:
        raise fault(
            files[0].parent if len(files) > 1 else files[0], "no run holds a complete row", "record the runs again"
        )
    _log_oddities(folder, tracks, dropped, tuple(unread))
    sent = _sent_commands(folder / SENT_FILE, robot)
    recording = Recording(robot, header, tuple(tracks), dict(dropped), digest.hexdigest(), sent=sent)
    try:
        warnings = judge(recording, replace(recording, tracks=tuple(in_degrees)) if in_degrees else None)
    except UserError as error:
        raise UserError(f"{folder}: {error}") from None
    for warning in warnings:
        logger.warning("%s: %s", folder, warning)
    blocks = in_blocks(recording.tracks)
    if len(blocks) > len(recording.tracks):
        cut = replace(recording, tracks=blocks)
        logger.info("%s: %d runs, taken as %d blocks", folder, len(recording.runs), len(cut.runs))
        recording = cut
    return replace(recording, warnings=warnings)


def _run_tables(files: Sequence[Path], robot: Robot, digest: "hashlib._Hash") -> Iterator[tuple[str, RunTable]]:
    """Yield each run's name and rows, in order of name; `digest` takes in the files."""
    if files[0].name == RUNS_FILE:
        with files[0].open("rb") as together:
            while part := together.read(2**24):
                digest.update(part)
        yield from parse_runs_together(files[0], robot)
        return
    for file in files:
        content = _read_bytes(file)
        digest.update(file.stem.encode() + b"\0" + hashlib.sha256(content).digest())
        yield file.stem, parse_run(file, content, robot)


def _sent_commands(file: Path, robot: Robot) -> Sent | None:
    if not file.exists():
        return None
    from swarmtwin.recordings.sent_commands import read_sent_commands  # pandas, only for those who have such a file

    return read_sent_commands(file, robot)


def look_into(folder: Path, robot: Robot) -> tuple[Header, list[Path]]:
    """Read what says that a folder is a recording of `robot`, and list the files of its runs; none of them is read.

    Raises:
        UserError: it is no such recording, or there are no runs in it.
    """
    header = read_header(folder)
    _check_header(folder / HEADER_FILE, header, robot)
    return header, _run_files(folder)


def read_header(folder: Path) -> Header:
    """Read `recording.yaml` in `folder`.

    Raises:
        UserError: the folder or the file is missing or unreadable, or the content is no header.
    """
    file = folder / HEADER_FILE
    if not folder.is_dir():
        raise UserError(f"no recording folder {folder}: name a folder that holds {HEADER_FILE} and {RUNS_FOLDER}/")
    if not file.exists():
        raise UserError(f"{file} is missing: a recording holds {HEADER_FILE} and {RUNS_FOLDER}/")
    try:
        content = read_yaml(file)
    except OSError as error:
        raise fault(file, f"it cannot be read ({error.strerror})", "check that it is there and may be read") from None
    except yaml.YAMLError as error:
        mark = getattr(error, "problem_mark", None)
        row = mark.line + 1 if mark else None
        what = f"not valid YAML ({getattr(error, 'problem', None) or 'not text'})"
        raise fault(file, what, "correct the file", row) from None
    if not isinstance(content, dict):
        raise fault(file, "there are no fields", "write robot, period_s, arena_mm and source, one a line")
    return Header.parse({name: _plain(value) for name, value in content.items()}, str(file))


def _plain(value: Any) -> Any:
    """YAML takes an unquoted date for more than text; a header wants the text."""
    return str(value) if isinstance(value, datetime.date) else value


def _check_header(file: Path, header: Header, robot: Robot) -> None:
    if header.robot != robot.name:
        what = f"the recording is of robot {header.robot!r}, not of {robot.name!r}"
        raise fault(file, what, f"add robot={header.robot}, or choose another recording")
    if not math.isclose(header.period_s, robot.period_s, rel_tol=1e-6):
        what = f"the period is {header.period_s:g} s, that of robot {robot.name!r} is {robot.period_s:g} s"
        raise fault(file, what, "correct it, or describe the robot with its own file in conf/robot/", column="period_s")


def _run_files(folder: Path) -> list[Path]:
    """List the files of the runs in order of name, without those of another kind; or the one file of all of them."""
    runs, together = folder / RUNS_FOLDER, folder / RUNS_FILE
    if together.exists():
        if runs.exists():
            raise UserError(f"{folder} holds both {RUNS_FOLDER}/ and {RUNS_FILE}: remove one of them")
        return [together]
    if not runs.is_dir():
        raise UserError(
            f"{runs} is missing: put one file a run there, {' or '.join(RUN_SUFFIXES)}, or all in {RUNS_FILE} beside it"
        )
    entries = sorted(entry for entry in runs.iterdir() if not entry.name.startswith("."))
    files = [entry for entry in entries if _is_run(entry)]
    others = [entry.name for entry in entries if not _is_run(entry)]
    if not files:
        there = f", only {', '.join(others[:5])}" if others else ""
        raise UserError(f"{runs} holds no run{there}: put one file a run there, {' or '.join(RUN_SUFFIXES)}")
    if repeated := [stem for stem, count in Counter(file.stem for file in files).items() if count > 1]:
        raise fault(runs, f"run {repeated[0]!r} stands there twice, as CSV and as Parquet", "remove one of them")
    return sorted(files, key=lambda file: file.stem)


def _log_others(runs: Path) -> None:
    if not runs.is_dir():
        return
    others = sorted(entry.name for entry in runs.iterdir() if not entry.name.startswith(".") and not _is_run(entry))
    if others:
        logger.warning("%s: %s left unread, no %s", runs, ", ".join(others[:5]), " or ".join(RUN_SUFFIXES))


def _is_run(entry: Path) -> bool:
    return entry.suffix in RUN_SUFFIXES and not entry.is_dir()


def _read_bytes(file: Path) -> bytes:
    check_regular(file)
    try:
        return file.read_bytes()
    except OSError as error:
        raise fault(file, f"it cannot be read ({error.strerror})", "check that it is there and may be read") from None


def _log_oddities(folder: Path, tracks: Sequence[Track], dropped: Counter[str], unread: Sequence[str]) -> None:
    if unread:
        logger.warning("%s: columns that nothing reads: %s", folder, ", ".join(unread))
    if dropped:
        counts = ", ".join(f"{reason} {count}" for reason, count in sorted(dropped.items()))
        logger.warning("%s: rows set aside while reading: %s", folder, counts)
    if overlap := _overlapping_runs(tracks):
        logger.warning(
            "%s: vehicle %r drives in runs %r and %r at the same time: count times from the start of the session",
            folder,
            *overlap,
        )


def _overlapping_runs(tracks: Sequence[Track]) -> tuple[str, str, str] | None:
    """Return the first vehicle and two runs in which it would have to be at the same time."""
    ordered = sorted(tracks, key=lambda track: (track.vehicle, track.time_s[0]))
    for earlier, later in itertools.pairwise(ordered):
        if earlier.vehicle == later.vehicle and later.time_s[0] < earlier.time_s[-1]:
            return earlier.vehicle, earlier.run, later.run
    return None
