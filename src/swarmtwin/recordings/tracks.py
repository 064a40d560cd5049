"""A run's rows become tracks, one a vehicle: checked for order, duplicates and identity."""

from collections import Counter
from collections.abc import Sequence

import numpy as np

from swarmtwin.geometry import wrap_angle
from swarmtwin.recordings.recording import Track, fault
from swarmtwin.recordings.tables import RunTable

# Why a row is set aside, or part of it made empty, while reading.
ROW_REASONS = {
    "truncated_row": "the file breaks off within its last row, which is left out",
    "no_time": "a row without time is left out, and the command before it is unknown",
    "duplicate_row": "a row that repeats the one before it is left out",
    "impossible_value": "a pose or command with an infinite number, or a heading of over 1000 turns, counts as missing",
}


def tracks_of(table: RunTable, run: str, vehicles: Sequence[str] | None) -> tuple[list[Track], Counter[str]]:
    """Split a run's rows into tracks, in order of the vehicles' ids, and count the rows set aside, by reason.

    Rows of several vehicles may interleave in any way: only each vehicle's own rows must be in order of time. Headings
    are wrapped. A pose or command with an impossible number becomes one of NaN. A row without time is left out, and the
    command of the row before it voided, since nobody knows how long it was held.

    Args:
        table: the rows.
        run: the run's name.
        vehicles: the ids that may occur; None where the header states none.

    Raises:
        UserError: a vehicle is not among `vehicles`, goes back in time, or is in two states at one time.
    """
    _check_vehicles(table, vehicles)
    tracks, dropped = [], Counter({"truncated_row": int(table.truncated)})
    command, impossible_command = _voided(table.command, np.inf)
    # A heading may be recorded unwrapped; beyond a thousand turns it is damage, and wrapping would make it look right.
    pose, impossible_pose = _voided(table.pose, np.array([np.inf, np.inf, 1000 * 2 * np.pi]))
    pose[:, 2] = wrap_angle(pose[:, 2])
    dropped["impossible_value"] += int((impossible_command | impossible_pose).sum())
    for code in np.argsort(table.vehicles):
        rows = np.flatnonzero(table.vehicle == code) if len(table.vehicles) > 1 else np.arange(len(table.time_s))
        rows = _without_timeless(table, rows, command, dropped)
        rows = _in_order(table, rows, dropped)
        if len(rows):
            tracks.append(Track(run, table.vehicles[code], table.time_s[rows], command[rows], pose[rows]))
    return tracks, +dropped


def _check_vehicles(table: RunTable, known: Sequence[str] | None) -> None:
    strangers = [index for index, vehicle in enumerate(table.vehicles) if known is not None and vehicle not in known]
    if known is None or not strangers:
        return
    row = int(np.argmax(table.vehicle == strangers[0]))
    what = f"vehicle {table.vehicles[strangers[0]]!r} is not among those of recording.yaml ({', '.join(known)})"
    raise fault(table.file, what, "correct the id, or add it there", table.row_number(row), "vehicle")


def _voided(values: np.ndarray, limit: np.ndarray | float) -> tuple[np.ndarray, np.ndarray]:
    """Return `values` (R, k) with incomplete and impossible rows all NaN, and which rows (R,) reached the `limit`."""
    impossible = (np.abs(values) >= limit).any(axis=1)
    complete = ~impossible & ~np.isnan(values).any(axis=1)
    return np.where(complete[:, None], values, np.nan), impossible


def _without_timeless(table: RunTable, rows: np.ndarray, command: np.ndarray, dropped: Counter[str]) -> np.ndarray:
    timeless = ~np.isfinite(table.time_s[rows])
    if not timeless.any():
        return rows
    command[rows[:-1][timeless[1:]]] = np.nan
    dropped["no_time"] += int(timeless.sum())
    return rows[~timeless]


def _in_order(table: RunTable, rows: np.ndarray, dropped: Counter[str]) -> np.ndarray:
    """Return one vehicle's `rows` without exact duplicates, in strictly increasing time."""
    time_s = table.time_s[rows]
    if (step := np.diff(time_s)).size == 0 or step.min() > 0:
        return rows
    vehicle = table.vehicles[table.vehicle[rows[0]]]
    if (step < 0).any():
        later = int(np.argmax(step < 0)) + 1
        what = f"vehicle {vehicle!r} goes back in time, from {time_s[later - 1]:g} s to {time_s[later]:g} s"
        remedy = "sort the rows by time; where the clock was set back, begin another run; a session is a recording"
        raise fault(table.file, what, remedy, table.row_number(int(rows[later])), "time_s")
    values = np.column_stack([table.command[rows], table.pose[rows]])
    same = ((values[1:] == values[:-1]) | (np.isnan(values[1:]) & np.isnan(values[:-1]))).all(axis=1)
    conflict = (step == 0) & ~same
    if conflict.any():
        later = int(np.argmax(conflict)) + 1
        what = f"vehicle {vehicle!r} has two different rows at {time_s[later]:g} s, as if two vehicles had one id"
        raise fault(table.file, what, "give each vehicle its own id", table.row_number(int(rows[later])), "vehicle")
    dropped["duplicate_row"] += int((step == 0).sum())
    return rows[np.append(True, step > 0)]
