"""The exact mean displacements that lie beside a stand-in's recording: for floors and model errors, and nothing else.

A stand-in knows what no camera sees. What is kept here of that is only what the best possible model would predict, for
each of several things that a model may know. Nothing that learns or diagnoses may read it.
"""

from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np
import pandas as pd
import pyarrow as pa
import pyarrow.parquet

from swarmtwin.errors import UserError
from swarmtwin.robot import DISPLACEMENT_COLUMNS

EXACT_MEANS_FILE = "truth.parquet"
INDEX_COLUMNS = ("run", "vehicle", "time_s")


def mean_columns(known: str) -> list[str]:
    """Return the columns of the mean displacement given what is `known`, mm, mm and rad."""
    return [f"{known}_{column}" for column in DISPLACEMENT_COLUMNS]


def exact_means_table(
    runs: Sequence[str], vehicles: Sequence[str], time_s: np.ndarray, means: Mapping[str, np.ndarray]
) -> pd.DataFrame:
    """Return exact means as a table, one row for each row of the recording that has a command.

    Args:
        runs: R names.
        vehicles: V ids.
        time_s: (R, T) when the rows were taken.
        means: mean displacements (R, T, V, 3), by what is known: `situation` (the command, at this time and place),
            `previous_command` (that one as well), `earlier_command` (the one before it as well).

    Returns:
        columns run, vehicle, time_s and three of each mean; R · V · T rows, in order of run, vehicle, time.
    """
    index = pd.MultiIndex.from_product([runs, vehicles, range(time_s.shape[1])])
    shape = (len(runs), len(vehicles), time_s.shape[1])
    columns = {
        "run": index.get_level_values(0),
        "vehicle": index.get_level_values(1),
        "time_s": np.broadcast_to(time_s[:, None], shape).ravel(),
    }
    for known, mean in means.items():
        by_vehicle = np.moveaxis(mean, 2, 1).reshape(-1, len(DISPLACEMENT_COLUMNS))
        columns |= dict(zip(mean_columns(known), by_vehicle.T, strict=True))
    return pd.DataFrame(columns)


def write_exact_means(folder: Path, table: pd.DataFrame) -> None:
    """Write exact means into a recording's folder."""
    table.to_parquet(folder / EXACT_MEANS_FILE, index=False)


def has_exact_means(folder: Path) -> bool:
    """Whether the recording in `folder` is a stand-in's."""
    return (folder / EXACT_MEANS_FILE).exists()


def read_exact_means(folder: Path) -> pd.DataFrame:
    """Read the exact means beside a stand-in's recording.

    Recordings of older versions hold `situation` and, in place of the means given the commands before, `everything`:
    the mean given the vehicle's true state, which no model sees.

    Returns:
        columns run, vehicle, time_s and three of each mean, as in `exact_means_table`.

    Raises:
        UserError: there are none, since the recording is of a real robot, or the file is damaged.
    """
    path = Path(folder) / EXACT_MEANS_FILE
    if not path.exists():
        raise UserError(f"{path} is missing: only recordings of stand-ins made by `swarmtwin record` have exact means")
    try:
        stored = pa.parquet.read_schema(path).names
        known = ["everything"] if "everything_turn_rad" in stored else ["previous_command", "earlier_command"]
        columns = [*INDEX_COLUMNS, *(column for level in ("situation", *known) for column in mean_columns(level))]
        return pd.read_parquet(path, columns=columns)
    except (pa.ArrowException, OSError, ValueError) as error:
        reason = (str(error).splitlines() or [type(error).__name__])[0]
        raise UserError(
            f"{path} is damaged ({reason}): copy it again, or record again with the same options and seed"
        ) from None
