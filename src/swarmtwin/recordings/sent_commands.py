"""A table of the commands that were sent: one row for each vehicle and time."""

from pathlib import Path

import numpy as np
import pandas as pd

from swarmtwin.errors import UserError, near_miss
from swarmtwin.files import check_regular
from swarmtwin.recordings.recording import Sent, fault
from swarmtwin.robot import Robot


def read_sent_commands(path: Path, robot: Robot) -> Sent:
    """Read a CSV or Parquet file with the columns time_s, vehicle and those of the robot's command; no others are read.

    Raises:
        UserError: the file is missing, lacks a column, or holds something that is no command of this robot; or a
            vehicle gets two commands at one time.
    """
    table = _table(path, robot).reset_index(drop=True)  # pandas writes where rows lay in another table
    for column in ("time_s", "vehicle", *robot.command_columns):
        if column not in table:
            raise fault(path, f"column {column!r} is missing", near_miss(column, table.columns), 1)
    if table.empty:
        raise fault(path, "there are no commands", "write one a row")
    numbers = table[["time_s", *robot.command_columns]].apply(pd.to_numeric, errors="coerce")
    low, high = np.append(-np.inf, robot.command_low), np.append(np.inf, robot.command_high)
    values = numbers.to_numpy(float)
    wrong = ~(np.isfinite(values) & (values >= low) & (values <= high))
    if wrong.any():
        row, column = np.argwhere(wrong)[0]
        name = numbers.columns[column]
        limits = f" from {low[column]:g} to {high[column]:g}" if column else ", in s"
        raise fault(path, f"{str(table[name].iloc[row])!r} is no {name}", f"write a number{limits}", int(row) + 2, name)
    sent = {}
    for vehicle, rows in table.groupby(table["vehicle"].astype(str)).groups.items():
        mine = values[np.asarray(rows)]
        mine = mine[np.argsort(mine[:, 0], kind="stable")]
        if (same := np.flatnonzero(np.diff(mine[:, 0]) == 0)).size:
            raise fault(
                path, f"vehicle {vehicle!r} gets two commands at {mine[same[0], 0]:g} s", "keep the one that was sent"
            )
        sent[str(vehicle)] = mine[:, 0], mine[:, 1:]
    return sent


def write_sent_commands(path: Path, robot: Robot, sent: Sent) -> None:
    """Write what `read_sent_commands` reads, as Parquet; times to 1 ms."""
    tables = [
        pd.DataFrame(command, columns=list(robot.command_columns)).assign(time_s=time_s.round(3), vehicle=vehicle)
        for vehicle, (time_s, command) in sent.items()
    ]
    table = pd.concat(tables).drop_duplicates(["vehicle", "time_s"], keep="last")
    table[["time_s", "vehicle", *robot.command_columns]].to_parquet(path, index=False)


def _table(path: Path, robot: Robot) -> pd.DataFrame:
    columns = ", ".join(("time_s", "vehicle", *robot.command_columns))
    if not path.exists():
        raise UserError(f"commands {path} is missing: name a CSV file with {columns}")
    check_regular(path)
    try:
        return pd.read_parquet(path) if path.suffix == ".parquet" else pd.read_csv(path, dtype={"vehicle": str})
    except (OSError, ValueError, pd.errors.ParserError) as error:
        why = " ".join(str(error).split())
        raise UserError(f"commands {path} cannot be read ({why}): name a CSV file with {columns}") from None
