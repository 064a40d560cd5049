"""`swarmtwin record`: stand-in robots drive; a recording results."""

from dataclasses import replace
from pathlib import Path
from typing import Annotated, Any

import numpy as np
import pandas as pd
from pydantic import BeforeValidator, Field
from rich.console import Console
from rich.table import Table

from swarmtwin.commands.sources import as_texts
from swarmtwin.errors import UserError, near_miss
from swarmtwin.files import new_folder
from swarmtwin.recordings.recording import Header, Recording, Track
from swarmtwin.recordings.writing import HEADING_DECIMALS, POSITION_DECIMALS, TIME_DECIMALS, FileFormat, write_recording
from swarmtwin.robot import Robot, StrictModel
from swarmtwin.standin.effects import parse_effects
from swarmtwin.standin.operator import Manner
from swarmtwin.standin.session import Footage, Session, film, require_stand_in
from swarmtwin.standin.truth import answer_book, write_truth
from swarmtwin.transitions import Counts, from_recording

SPARE_RUNS = 2
MOST_ROWS = 20_000_000  # at some 1.4 kB of memory a row


class Options(StrictModel):
    """Options of `swarmtwin record`; their defaults stand in conf/record.yaml."""

    robot: Robot
    vehicle: Annotated[tuple[str, ...], BeforeValidator(as_texts), Field(min_length=1)]
    runs: Annotated[int, Field(ge=1)]
    steps: Annotated[int, Field(ge=1)]
    transitions: Annotated[int, Field(ge=1)] | None
    seed: Annotated[int, Field(ge=0)]
    effects: tuple[Any, ...]
    commands: Manner
    drive: Path | None
    lost_poses: Annotated[float, Field(ge=0, lt=1)]
    format: FileFormat
    output: Path
    overwrite: bool


def run(options: Options) -> None:
    """Record, and show what the recording holds. Nothing in it tells which effects were on, or that any were.

    Raises:
        UserError: the robot has no stand-in, an effect or the drive makes no sense, or the output is taken.
    """
    session = plan_session(options)
    config = options.model_dump(mode="json", exclude={"effects"})
    with new_folder(options.output, "record", config, options.overwrite) as folder:
        footage, recording = record(session, options.transitions)
        write_recording(folder, options.robot, recording.header, recording.tracks, options.format)
        write_truth(folder, _answers(footage, recording))
        _, counts = from_recording(recording)
    Console().print(_summary(options.output, recording, counts))


def plan_session(options: Options) -> Session:
    """Return the session that the options ask for.

    Raises:
        UserError: the robot has no stand-in, an effect or the drive makes no sense for it, or the recording would be
            too long.
    """
    require_stand_in(options.robot)
    if twice := sorted({vehicle for vehicle in options.vehicle if options.vehicle.count(vehicle) > 1}):
        raise UserError(f"vehicle {twice[0]!r} is named twice: give each id once")
    if options.transitions and len(options.vehicle) > 1:
        raise UserError("transitions=... cuts the runs of one vehicle: give one vehicle, or runs=... instead")
    runs = options.runs
    if options.transitions:
        runs = -(-options.transitions // options.steps)
    _check_size(runs, options.steps, len(options.vehicle))
    return Session(
        robot=options.robot,
        vehicles=options.vehicle,
        runs=runs,
        steps=options.steps,
        seed=options.seed,
        effects=parse_effects(options.effects, options.robot, len(options.vehicle)),
        manner=options.commands,
        drive=None if options.drive is None else read_drive(options.drive, options.robot),
        lost_poses=options.lost_poses,
        planned_runs=runs,
    )


def _check_size(runs: int, steps: int, vehicles: int) -> None:
    """Refuse what no memory holds, before anything is driven."""
    rows = runs * (steps + 1) * vehicles
    if rows > MOST_ROWS:
        raise UserError(
            f"a recording of {rows:,} rows ({runs:,} runs of {steps:,} steps, vehicles: {vehicles}) is too long: "
            f"stay below {MOST_ROWS:,} rows, with several recordings if need be"
        )


def read_drive(path: Path, robot: Robot) -> np.ndarray:
    """Read commands (N, m) from a CSV file with the robot's command columns; further columns are left alone.

    Raises:
        UserError: the file is missing, lacks a column, or holds something that is no command of this robot.
    """
    try:
        table = pd.read_csv(path)
    except FileNotFoundError:
        raise UserError(f"drive {path} is missing: name a CSV file with {', '.join(robot.command_columns)}") from None
    except OSError as error:
        raise UserError(f"drive {path} cannot be read ({error.strerror}): name a CSV file") from None
    except (pd.errors.ParserError, pd.errors.EmptyDataError, UnicodeDecodeError) as error:
        raise UserError(f"drive {path} is no CSV file: {error}") from None
    for column, limits in robot.command.items():
        if column not in table:
            raise UserError(f"drive {path}: column {column!r} is missing: {near_miss(column, table.columns)}")
        values = pd.to_numeric(table[column], errors="coerce")
        if len(bad := np.flatnonzero(~values.between(limits.low, limits.high))):
            raise UserError(
                f"drive {path}, row {bad[0] + 2}: {column} is {table[column].iloc[bad[0]]!s}: "
                f"write a number from {limits.low:g} to {limits.high:g} {limits.unit}"
            )
    if table.empty:
        raise UserError(f"drive {path} holds no command: write one a row")
    return table[list(robot.command_columns)].to_numpy(float)


def record(session: Session, transitions: int | None = None) -> tuple[Footage, Recording]:
    """Film a session; with `transitions`, as many runs as it takes until so many are usable, the last one cut there.

    Raises:
        UserError: so few are usable that the recording would be too long.
    """
    if transitions is None:
        footage = film(session)
        return footage, _recording(footage)
    session = replace(session, runs=session.runs + SPARE_RUNS + session.runs // 100)
    while True:
        footage = film(session)
        recording = _recording(footage)
        usable, counts = from_recording(recording)
        if counts.kept >= transitions:
            last = transitions - 1
            return _cut(footage, recording, int(usable.run[last]), float(usable.time_s[last]))
        missing = transitions - counts.kept
        session = replace(session, runs=session.runs + missing // session.steps + SPARE_RUNS)
        _check_size(session.runs, session.steps, len(session.vehicles))


def _recording(footage: Footage) -> Recording:
    """Return what the camera and the link saw, as finely as a recording holds it."""
    session = footage.session
    header = Header(
        robot=session.robot.name,
        period_s=session.robot.period_s,
        arena_mm=session.robot.arena_mm,
        source=f"stand-in {session.robot.name}",
        vehicles=session.vehicles,
    )
    decimals = (POSITION_DECIMALS, POSITION_DECIMALS, HEADING_DECIMALS)
    pose = np.stack([footage.pose[..., axis].round(places) for axis, places in enumerate(decimals)], axis=-1)
    time_s = footage.time_s.round(TIME_DECIMALS)
    none = np.full((*footage.command.shape[:1], 1, *footage.command.shape[2:]), np.nan)
    command = np.concatenate([footage.command, none], axis=1)
    tracks = tuple(
        Track(_run_name(run), vehicle, time_s[run], command[run, :, index], pose[run, :, index])
        for run in range(len(time_s))
        for index, vehicle in enumerate(session.vehicles)
    )
    return Recording(session.robot, header, tracks)


def _run_name(run: int) -> str:
    return f"run_{run + 1:04d}"


def _cut(footage: Footage, recording: Recording, last_run: int, last_start_s: float) -> tuple[Footage, Recording]:
    """End the recording of one vehicle with the transition of run `last_run` that starts at `last_start_s`."""
    whole = recording.tracks[last_run]
    rows = int(np.searchsorted(whole.time_s, last_start_s)) + 2
    command = whole.command[:rows].copy()
    command[-1] = np.nan
    last = Track(whole.run, whole.vehicle, whole.time_s[:rows], command, whole.pose[:rows])
    return footage.first_runs(last_run + 1), replace(recording, tracks=(*recording.tracks[:last_run], last))


def _answers(footage: Footage, recording: Recording) -> pd.DataFrame:
    """Return the answer book of the rows that the recording holds, at the times it holds."""
    table = answer_book(footage, recording.runs)
    table["time_s"] = table["time_s"].round(TIME_DECIMALS)
    last = recording.tracks[-1]
    return table[(table["run"] != last.run) | (table["time_s"] < last.time_s[-1])]


def _summary(output: Path, recording: Recording, counts: Counts) -> Table:
    table = Table("", "", title=f"{output} ({recording.header.source})", show_header=False)
    table.add_row("vehicles", ", ".join(recording.vehicles))
    table.add_row("runs", str(len(recording.runs)))
    table.add_row("rows", str(counts.rows))
    table.add_row("usable transitions", str(counts.kept))
    for reason, count in counts.dropped.items():
        table.add_row(f"  not usable: {reason}", str(count))
    return table
