"""Stand-ins are driven and filmed: what a camera and a link would have seen becomes a recording."""

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pandas as pd

from swarmtwin.errors import UserError, near_miss
from swarmtwin.recordings.exact_means import exact_means_table
from swarmtwin.recordings.recording import Header, Recording, Track
from swarmtwin.recordings.writing import HEADING_DECIMALS, POSITION_DECIMALS, TIME_DECIMALS
from swarmtwin.robot import Robot
from swarmtwin.standin.exact_means import means_given_commands
from swarmtwin.standin.session import DrivenSession, StandInSession, drive_session
from swarmtwin.transitions import from_recording


def record(
    session: StandInSession,
    transitions: int | None = None,
    *,
    drive: Callable[[StandInSession], DrivenSession] = drive_session,
    most_rows: int = 20_000_000,
) -> tuple[DrivenSession, Recording]:
    """Drive and film a session, and return it with all that the stand-in knows, and as a laboratory would have it.

    With `transitions`, as many runs are driven as it takes until so many are usable; the last one ends there. A
    recording never gets longer than `most_rows`. `drive` is what moves the vehicles: formulas, or another engine.

    Raises:
        UserError: so few are usable that the recording would be too long, or the engine refuses the session.
    """
    if transitions is None:
        footage = drive(session)
        return footage, _recording(footage)
    spare_runs = 2  # lost poses make some rows unusable: with a per cent of the runs more, one pass nearly always does
    session = replace(session, runs=session.runs + spare_runs + session.runs // 100)
    while True:
        footage = drive(session)
        recording = _recording(footage)
        usable, counts = from_recording(recording)
        if counts.kept >= transitions:
            last = transitions - 1
            return _ended_at(footage, recording, int(usable.run[last]), float(usable.time_s[last]))
        missing = transitions - counts.kept
        session = replace(session, runs=session.runs + missing // session.steps + spare_runs)
        check_size(session.runs, session.steps, len(session.vehicles), most_rows)


def _recording(footage: DrivenSession) -> Recording:
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
        Track(f"run_{run + 1:04d}", vehicle, time_s[run], command[run, :, index], pose[run, :, index])
        for run in range(len(time_s))
        for index, vehicle in enumerate(session.vehicles)
    )
    return Recording(session.robot, header, tracks)


def _ended_at(
    footage: DrivenSession, recording: Recording, last_run: int, last_start_s: float
) -> tuple[DrivenSession, Recording]:
    """End the recording of one vehicle with the transition of run `last_run` that starts at `last_start_s`."""
    whole = recording.tracks[last_run]
    rows = int(np.searchsorted(whole.time_s, last_start_s)) + 2
    command = whole.command[:rows].copy()
    command[-1] = np.nan
    last = Track(whole.run, whole.vehicle, whole.time_s[:rows], command, whole.pose[:rows])
    return footage.first_runs(last_run + 1), replace(recording, tracks=(*recording.tracks[:last_run], last))


def exact_means_of(footage: DrivenSession, recording: Recording) -> pd.DataFrame:
    """Return the exact means of the rows that the recording holds, at the times it holds."""
    known = ("situation", "previous_command", "earlier_command")
    means = dict(zip(known, means_given_commands(footage, len(known) - 1), strict=True))
    time_s = footage.time_s[:, :-1].round(TIME_DECIMALS)
    table = exact_means_table(recording.runs, footage.session.vehicles, time_s, means)
    last = recording.tracks[-1]
    return table[(table["run"] != last.run) | (table["time_s"] < last.time_s[-1])]


def check_size(runs: int, steps: int, vehicles: int, most_rows: int = 20_000_000) -> None:
    """Refuse what no memory holds, before anything is driven: a row takes some 1.4 kB, the usual limit 28 GB.

    Raises:
        UserError: the recording would be too long.
    """
    rows = runs * (steps + 1) * vehicles
    if rows > most_rows:
        raise UserError(
            f"a recording of {rows:,} rows ({runs:,} runs of {steps:,} steps, vehicles: {vehicles}) is too long: "
            f"stay below {most_rows:,} rows, with several recordings if need be"
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
