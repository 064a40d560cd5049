"""How fast a million rows are read and prepared: figures to look at with `pytest -s -m benchmark_figures`."""

import subprocess
import sys
import time
from pathlib import Path

import pandas as pd
import pytest

from drives import drive, write_drive

PREPARE = """
import resource, sys, time
from pathlib import Path
from swarmtwin.recordings.reading import read_recording
from swarmtwin.robot import Robot
from swarmtwin.transitions import Fractions, from_recording, split_by_run
from swarmtwin.transitions.preparation import describe, save_preparation
folder, robot_file, output = map(Path, sys.argv[1:])
start = time.perf_counter()
recording = read_recording(folder, Robot.load(robot_file))
read_s = time.perf_counter() - start
fractions = Fractions(train=0.85, validation=0.05, test=0.10)
transitions, counts = from_recording(recording)
transitions = split_by_run(transitions, fractions, seed=1)
save_preparation(output, transitions, describe(recording, "benchmark", transitions, counts, fractions, 1))
total_s = time.perf_counter() - start
print(read_s, total_s, resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024, counts.rows, counts.kept)
"""


@pytest.mark.benchmark_figures
@pytest.mark.parametrize(("runs", "steps"), [(1000, 999), (5_000, 199)], ids=["1000_long_runs", "5000_short_runs"])
def test_a_million_rows_are_read_and_prepared(robots, tmp_path, runs, steps):
    folder = write_drive(tmp_path / "recording", robots["mgr"], drive(robots["mgr"], runs, steps, vehicles=("1",)))
    robot_file, output = Path(__file__).resolve().parents[2] / "conf" / "robot" / "mgr.yaml", tmp_path / "prepared"
    output.mkdir()
    command = [sys.executable, "-c", PREPARE, str(folder), str(robot_file), str(output)]
    read_s, total_s, peak_mib, rows, kept = map(
        float, subprocess.run(command, check=True, capture_output=True, text=True).stdout.split()
    )
    start = time.perf_counter()
    frames = [pd.read_csv(file) for file in sorted((folder / "runs").iterdir())]
    pandas_s = time.perf_counter() - start
    assert sum(map(len, frames)) == rows == runs * (steps + 1)
    assert kept == runs * steps
    print(
        f"\n{rows:,.0f} rows in {runs:,} files: read {read_s:.2f} s, read and prepared {total_s:.2f} s "
        f"({rows / total_s:,.0f} rows/s), peak memory {peak_mib:,.0f} MiB; "
        f"reading takes {read_s / pandas_s:.2f} times what pandas.read_csv alone takes ({pandas_s:.2f} s)"
    )
