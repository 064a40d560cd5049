"""Reading a recording: its header, its runs, and everything a camera and a network get wrong in them."""

import datetime
import hashlib
import itertools
import logging
import math
from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import yaml

from swarmtwin.errors import UserError
from swarmtwin.files import check_regular
from swarmtwin.plain_yaml import read_yaml
from swarmtwin.recordings.blocks import FEWEST_RUNS, enough_runs, in_blocks, run_of, table_in_blocks
from swarmtwin.recordings.plausibility.judgement import judge
from swarmtwin.recordings.plausibility.run_times import Span, clock_warnings
from swarmtwin.recordings.plausibility.sampled_rows import SampledRows
from swarmtwin.recordings.plausibility.sent_log import SentLog
from swarmtwin.recordings.recording import SENT_FILE, Header, Recording, Sent, Track, fault
from swarmtwin.recordings.tables import RunTable, count_runs, parse_run, parse_runs_together
from swarmtwin.recordings.tracks import tracks_of
from swarmtwin.robot import Robot

HEADER_FILE = "recording.yaml"
RUNS_FOLDER = "runs"
RUNS_FILE = "runs.parquet"
RUN_SUFFIXES = (".csv", ".parquet")

logger = logging.getLogger(__name__)


def read_recording(folder: Path, robot: Robot) -> Recording:
    """Read the recording of `robot` in `folder`, and judge it as a whole. Nothing in it is modified.

    Where there are few runs, long ones are cut into blocks, and very long ones always; blocks count as runs from here
    on: see `table_in_blocks`.

    Faults of single rows are counted in `Recording.dropped_rows` and logged in one line; what is unusual of the whole
    is in `Recording.warnings`, and logged.

    Raises:
        UserError: for a fault of a file, naming the file, the row, the column and the remedy; or the recording as a
            whole cannot be what it says.
    """
    tracks: list[Track] = []
    whole = read_in_parts(folder, robot, lambda part: tracks.extend(part.tracks))
    return replace(whole, tracks=tuple(tracks))


def read_in_parts(
    folder: Path, robot: Robot, take: Callable[[Recording], None], rows_at_a_time: int = 250_000
) -> Recording:
    """Read a recording as `read_recording` does, of which no more than a part is in memory at a time.

    Args:
        folder: the recording's.
        robot: whose it is.
        take: given the recording's parts one after the other, each of whole runs or blocks, in order. What it makes of
            them is to be thrown away if an error follows: the recording is judged when all of it has been read.
        rows_at_a_time: about so many rows make a part, or one run or block does that has more.

    Returns:
        What is known of the whole; its tracks, which `take` was given, are left out.

    Raises:
        UserError: as `read_recording`.
    """
    folder = Path(folder)
    header, files = look_into(folder, robot)
    _log_others(folder / RUNS_FOLDER)
    runs = _runs_in(files)
    sent = _sent_commands(folder / SENT_FILE, robot)
    whole = Recording(robot, header, (), sent=sent)
    parts = _Parts(whole, take, rows_at_a_time, few=not enough_runs(runs))
    dropped: Counter[str] = Counter()
    unread: dict[str, None] = {}
    digest = hashlib.sha256()
    for run, table in _run_tables(files, robot, digest):
        unread |= dict.fromkeys(table.unread)
        for name, rows in table_in_blocks(run, table, runs):
            tracks, run_dropped = tracks_of(rows, name, header.vehicles)
            dropped += run_dropped
            parts.add(tracks, rows)
    parts.judge_all()
    if not parts.spans:
        raise fault(
            files[0].parent if len(files) > 1 else files[0], "no run holds a complete row", "record the runs again"
        )
    _log_oddities(folder, dropped, tuple(unread))
    warnings = _logged(folder, clock_warnings(parts.spans))
    try:
        warnings += _logged(folder, judge(header, parts.rows, parts.in_degrees, parts.sent_log))
    except UserError as error:
        raise UserError(f"{folder}: {error}") from None
    parts.give_rest()
    if parts.blocks > len({run_of(span.run) for span in parts.spans}):
        logger.info("%s: long runs, taken as %d blocks", folder, parts.blocks)
    return replace(whole, dropped_rows=dict(dropped), digest=digest.hexdigest(), warnings=warnings)


class _Parts:
    """Puts runs together to parts as they are read, lets what it is judged by pass by, and gives the parts away.

    What is read may be blocks of runs, which count as runs.

    Attributes:
        spans: of the tracks so far, in order.
        rows: what the recording is judged by.
        in_degrees: the same with headings taken for degrees, from the first run on that has one beyond a turn; None
            where there is none.
        sent_log: the rows beside the log of the commands; None where there is none.
        blocks: so many runs, or blocks of these, there were so far.
    """

    def __init__(self, whole: Recording, take: Callable[[Recording], None], rows_at_a_time: int, few: bool) -> None:
        self.spans: list[Span] = []
        self.rows = SampledRows(whole.robot)
        self.in_degrees: SampledRows | None = None
        self.sent_log = SentLog(whole.robot, whole.sent) if whole.sent else None
        self._whole, self._take, self._rows_at_a_time = whole, take, rows_at_a_time
        self.blocks = 0
        self._few = few
        self._beyond_a_turn = False
        self._waiting: list[Track] = []
        self._unjudged: list[Track] = []
        self._unjudged_in_degrees: list[Track] = []
        self._unjudged_rows = 0

    def add(self, tracks: Sequence[Track], table: RunTable) -> None:
        """Add the tracks of the next run, of which there may be none, and the rows that they come from."""
        self._beyond_a_turn |= bool(np.any(np.abs(table.pose[:, 2]) > 2 * np.pi))
        if not tracks:
            return
        self.spans += [
            Span(track.vehicle, float(track.time_s[0]), float(track.time_s[-1]), track.run) for track in tracks
        ]
        self.blocks += 1
        self._waiting += tracks
        self._unjudged += tracks
        self._unjudged_rows += sum(map(len, tracks))
        if self._beyond_a_turn:
            self.in_degrees = self.in_degrees or SampledRows(self._whole.robot)
            known = self._whole.header.vehicles
            self._unjudged_in_degrees += tracks_of(table.with_headings_in_degrees(), tracks[0].run, known)[0]
        if self._unjudged_rows >= self._rows_at_a_time:
            self.judge_all()
            if self._few or enough_runs(self.blocks):
                self._give_waiting()

    def judge_all(self) -> None:
        """Let what has not yet been looked at pass by."""
        self.rows.add(self._unjudged)
        if self.sent_log is not None:
            self.sent_log.add(self._unjudged)
        if self.in_degrees is not None:
            self.in_degrees.add(self._unjudged_in_degrees)
        self._unjudged, self._unjudged_in_degrees, self._unjudged_rows = [], [], 0

    def give_rest(self) -> None:
        """Give away what is left, cut into blocks where runs are few beside those that hold no complete row."""
        if not self._few and not enough_runs(self.blocks):
            self._waiting = list(in_blocks(self._waiting))
            self.blocks = len({block.run for block in self._waiting})
        self._give_waiting()

    def _give_waiting(self) -> None:
        """Give away what waits, in parts of whole runs or blocks."""
        part: list[Track] = []
        for _, run in itertools.groupby(self._waiting, key=lambda track: track.run):
            part += run
            if sum(map(len, part)) >= self._rows_at_a_time:
                self._give(part)
                part = []
        if part:
            self._give(part)
        self._waiting = []

    def _give(self, tracks: Sequence[Track]) -> None:
        self._take(replace(self._whole, tracks=tuple(tracks)))


def _runs_in(files: Sequence[Path]) -> int:
    """Return how many runs there are in files, empty ones included; of a file of many runs, no more than are enough."""
    return count_runs(files[0], FEWEST_RUNS) if files[0].name == RUNS_FILE else len(files)


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


def _log_oddities(folder: Path, dropped: Counter[str], unread: Sequence[str]) -> None:
    if unread:
        logger.warning("%s: columns that nothing reads: %s", folder, ", ".join(unread))
    if dropped:
        counts = ", ".join(f"{reason} {count}" for reason, count in sorted(dropped.items()))
        logger.warning("%s: rows set aside while reading: %s", folder, counts)


def _logged(folder: Path, warnings: tuple[str, ...]) -> tuple[str, ...]:
    for warning in warnings:
        logger.warning("%s: %s", folder, warning)
    return warnings
