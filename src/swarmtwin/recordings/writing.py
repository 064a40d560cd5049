"""Writing a recording in the format that `reading` reads."""

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Literal

import numpy as np
import pyarrow as pa
import pyarrow.csv
import pyarrow.parquet
import yaml

from swarmtwin.errors import UserError
from swarmtwin.recordings.reading import HEADER_FILE, RUNS_FILE, RUNS_FOLDER
from swarmtwin.recordings.recording import Header, Track
from swarmtwin.recordings.tables import RUN_COLUMN, run_columns
from swarmtwin.robot import Robot

FileFormat = Literal["csv", "parquet", "one_file"]

# Finer than any camera or clock: 1 ms, 0.001 mm, 0.00001 rad.
TIME_DECIMALS, POSITION_DECIMALS, HEADING_DECIMALS, COMMAND_DECIMALS = 3, 3, 5, 6


def write_recording(
    folder: Path,
    robot: Robot,
    header: Header,
    tracks: Sequence[Track],
    file_format: FileFormat | None = "csv",
    many_runs: int = 100,
) -> None:
    """Write `recording.yaml` and the runs into an existing `folder`, as `files.new_folder` gives it.

    Times are rounded to 1 ms, positions to 0.001 mm, headings to 1e-5 rad, commands to 1e-6; NaN becomes an empty cell.
    Rows of several vehicles interleave in order of time.

    Args:
        folder: the recording's.
        robot: whose columns are written.
        header: of the recording.
        tracks: what was driven.
        file_format: `csv` or `parquet`: one file a run, in `runs/`; `one_file`: all in `runs.parquet`; None: CSV, or
            one file where there are many runs.
        many_runs: these, at least.

    Raises:
        UserError: a run or vehicle has a name that the format cannot hold.
    """
    content = header.model_dump(mode="json", exclude_none=True)
    (folder / HEADER_FILE).write_text(yaml.safe_dump(content, sort_keys=False, allow_unicode=True))
    by_run: dict[str, list[Track]] = {}
    for track in tracks:
        _check_names(track)
        by_run.setdefault(track.run, []).append(track)
    if file_format is None:
        file_format = "one_file" if len(by_run) >= many_runs else "csv"
    if file_format == "one_file":
        _write_together(folder / RUNS_FILE, by_run, robot)
        return
    (folder / RUNS_FOLDER).mkdir()
    for run, run_tracks in by_run.items():
        table = _table(run_tracks, robot)
        path = folder / RUNS_FOLDER / f"{run}.{file_format}"
        if file_format == "parquet":
            pa.parquet.write_table(table, path, write_page_checksum=True)
        else:
            options = pa.csv.WriteOptions(quoting_style="none", quoting_header="none")
            pa.csv.write_csv(table, path, write_options=options)


def _write_together(
    file: Path, by_run: Mapping[str, Sequence[Track]], robot: Robot, rows_a_group: int = 100_000
) -> None:
    """Write all runs into one file, in order of name; it can be read a group of rows at a time, as it is written."""
    schema = pa.schema([(RUN_COLUMN, pa.string()), *_table(next(iter(by_run.values())), robot).schema])
    waiting: list[pa.Table] = []
    with pa.parquet.ParquetWriter(file, schema, write_page_checksum=True) as writer:
        for run in sorted(by_run):
            table = _table(by_run[run], robot)
            waiting.append(table.add_column(0, RUN_COLUMN, pa.array([run] * len(table), pa.string())).cast(schema))
            if sum(map(len, waiting)) >= rows_a_group:
                writer.write_table(pa.concat_tables(waiting))
                waiting = []
        if waiting:
            writer.write_table(pa.concat_tables(waiting))


def _check_names(track: Track) -> None:
    if not track.run or track.run.startswith(".") or any(sign in track.run for sign in "/\\\0"):
        raise UserError(f"run {track.run!r} cannot be a file's name: use letters, digits, '_' and '-'")
    if not track.vehicle.strip() or any(sign in track.vehicle for sign in ',"\r\n\0'):
        raise UserError(f"vehicle {track.vehicle!r} cannot be an id: use letters, digits, '_' and '-'")


def _table(tracks: Sequence[Track], robot: Robot) -> pa.Table:
    """Return one run's rows in order of time, then vehicle; NaN as null."""
    time_s = np.concatenate([track.time_s for track in tracks]).round(TIME_DECIMALS)
    vehicle = np.concatenate([np.full(len(track), track.vehicle, dtype=object) for track in tracks])
    command = np.concatenate([track.command for track in tracks]).round(COMMAND_DECIMALS)
    pose = np.concatenate([track.pose for track in tracks])
    position, heading = pose[:, :2].round(POSITION_DECIMALS), pose[:, 2:].round(HEADING_DECIMALS)
    order = np.argsort(time_s, kind="stable")
    columns = [time_s, vehicle, *command.T, *position.T, *heading.T]
    return pa.table({name: _column(values[order]) for name, values in zip(run_columns(robot), columns, strict=True)})


def _column(values: np.ndarray) -> pa.Array:
    if values.dtype == object:
        return pa.array(values, pa.string())
    return pa.array(values + 0.0, pa.float64(), from_pandas=True)  # −0 becomes 0, NaN null
