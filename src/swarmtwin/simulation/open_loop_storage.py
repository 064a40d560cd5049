"""Runs predicted open loop as one parquet file, with the arena they were driven in, to be drawn again."""

from collections.abc import Sequence
from pathlib import Path

import numpy as np
import pandas as pd
import pyarrow as pa
import pyarrow.parquet

from swarmtwin.recordings.recording import Track, fault
from swarmtwin.robot import POSE_COLUMNS, Arena
from swarmtwin.simulation.open_loop import OpenLoop

PREDICTED_COLUMNS = tuple(f"predicted_{name}" for name in POSE_COLUMNS)


def save_open_loop(file: Path, runs: Sequence[OpenLoop], arena: Arena) -> None:
    """Write a row for each moment of each run: the pose as measured and as predicted, and the RMSE of its run."""
    lengths = [len(run.track) for run in runs]
    measured = np.concatenate([np.empty((0, 3)), *(run.track.pose for run in runs)])
    predicted = np.concatenate([np.empty((0, 3)), *(run.predicted for run in runs)])
    columns = {
        "run": pa.array(np.repeat([run.track.run for run in runs], lengths).tolist(), pa.string()),
        "vehicle": pa.array(np.repeat([run.track.vehicle for run in runs], lengths).tolist(), pa.string()),
        "time_s": np.concatenate([np.empty(0), *(run.track.time_s for run in runs)]),
        **dict(zip(POSE_COLUMNS, measured.T, strict=True)),
        **dict(zip(PREDICTED_COLUMNS, predicted.T, strict=True)),
        "rmse_mm": np.repeat([float(run.rmse_mm) for run in runs], lengths).astype(float),
    }
    pa.parquet.write_table(pa.table(columns, metadata={"arena_mm": arena.model_dump_json()}), file)


def load_open_loop(file: Path) -> tuple[list[OpenLoop], Arena]:
    """Read the runs and their arena; the commands of their tracks are not kept: (T, 0).

    Raises:
        UserError: the file is missing or damaged.
    """
    try:
        content = pa.parquet.read_table(file)
        arena = Arena.model_validate_json(content.schema.metadata[b"arena_mm"])
        table = content.to_pandas()
        parts = table.groupby(["run", "vehicle"], sort=False)
        return [_run(str(run), str(vehicle), rows) for (run, vehicle), rows in parts], arena
    except (pa.ArrowException, OSError, ValueError, KeyError, TypeError) as error:
        what = f"no runs can be read ({str(error).splitlines()[0]})"
        raise fault(file, what, "run the command that left them again") from None


def _run(name: str, vehicle: str, rows: pd.DataFrame) -> OpenLoop:
    pose = rows[list(POSE_COLUMNS)].to_numpy(float)
    track = Track(name, vehicle, rows["time_s"].to_numpy(float), np.empty((len(rows), 0)), pose)
    return OpenLoop(track, rows[list(PREDICTED_COLUMNS)].to_numpy(float), float(rows["rmse_mm"].iloc[0]))
