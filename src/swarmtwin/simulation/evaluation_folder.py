"""What measuring a simulation leaves: its figures, and what it predicted of transitions and of whole runs."""

import json
from pathlib import Path

import numpy as np
import pandas as pd

from swarmtwin.files import write_text
from swarmtwin.robot import DISPLACEMENT_COLUMNS, Arena
from swarmtwin.simulation.evaluation import Measurement
from swarmtwin.simulation.open_loop_storage import save_open_loop

METRICS, ONE_STEP, OPEN_LOOP = "metrics.json", "one_step.parquet", "open_loop.parquet"
PREDICTED_COLUMNS = tuple(f"predicted_{name}" for name in DISPLACEMENT_COLUMNS)


def save_measurement(folder: Path, measurement: Measurement, arena: Arena, about: dict[str, str]) -> None:
    """Write `metrics.json`, which begins with `about`, and every prediction beside what was measured."""
    write_text(folder / METRICS, json.dumps({**about, **measurement.metrics()}, indent=1) + "\n")
    measured = dict(zip(DISPLACEMENT_COLUMNS, measurement.transitions.displacement.T, strict=True))
    predicted = dict(zip(PREDICTED_COLUMNS, measurement.predicted.T, strict=True))
    pd.DataFrame(measured | predicted).to_parquet(folder / ONE_STEP, index=False)
    save_open_loop(folder / OPEN_LOOP, measurement.runs, arena)


def load_one_step(folder: Path) -> tuple[np.ndarray, np.ndarray]:
    """Return the predicted and the measured displacements, each (N, 3) forward_mm, left_mm, turn_rad."""
    table = pd.read_parquet(folder / ONE_STEP)
    return table[list(PREDICTED_COLUMNS)].to_numpy(), table[list(DISPLACEMENT_COLUMNS)].to_numpy()
