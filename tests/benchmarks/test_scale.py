"""How memory and time grow with a recording, from one to ten million rows: `pytest -s -m benchmark_figures`."""

import shutil

import numpy as np
import pyarrow as pa
import pyarrow.parquet
import pytest

from measured_command import called

RUNS, STEPS = 200, 99


def repeated(driven, folder, times, drives):
    """Write a recording of `times` · 20,000 rows in one file: sessions of one drive, each seen a little anew.

    Their runs are short, or all together make up so many long `drives`.
    """
    folder.mkdir()
    shutil.copy(driven / "recording.yaml", folder)
    table, random = pyarrow.parquet.read_table(driven / "runs.parquet"), np.random.default_rng(1)
    runs = np.array(table["run"].to_pylist(), dtype=object)
    columns = {name: table[name].to_numpy() for name in table.column_names if name not in ("run", "vehicle")}
    session_s = columns["time_s"].max() + 10
    with pyarrow.parquet.ParquetWriter(folder / "runs.parquet", table.schema, write_page_checksum=True) as writer:
        for number in range(times):
            seen = {name: columns[name] + random.normal(0, 0.3, len(table)) for name in ("x_mm", "y_mm")}
            own = columns | seen | {"time_s": columns["time_s"] + number * session_s}
            arrays = {name: pa.array(values, from_pandas=True) for name, values in own.items()}
            names = f"{number:04}_" + runs if drives is None else [f"{number * drives // times:04}"] * len(table)
            arrays |= {"run": pa.array(names), "vehicle": table["vehicle"]}
            writer.write_table(pa.table({name: arrays[name] for name in table.column_names}).cast(table.schema))
    return times * len(table)


@pytest.mark.benchmark_figures
@pytest.mark.parametrize("drives", [None, 4, 1], ids=["short_runs", "four_drives", "one_drive"])
def test_ten_million_rows_are_prepared_and_learned_from(tmp_path, drives):
    """Peaks are asserted, since they are the promise; times are shown."""
    learn = ("train", "robot=mgr", "model=mlp", "seeds=1", "register=false", "pictures=false")
    drive = ("robot=mgr", "vehicle=1", f"runs={RUNS}", f"steps={STEPS}", "format=one_file", "output=driven")
    called(tmp_path, "record", *drive)
    figures = {}
    for times in (50, 500):
        rows = repeated(tmp_path / "driven", tmp_path / f"rows_{times}", times, drives)
        prepared = (f"recording=rows_{times}", f"output=prepared_{times}")
        figures[rows] = {
            "prepared": called(tmp_path, "prepare", "robot=mgr", *prepared),
            "learned from": called(tmp_path, *learn, f"transitions=prepared_{times}", f"output=model_{times}"),
            "prepared and learned from": called(tmp_path, *learn, prepared[0], f"output=recorded_{times}"),
        }
    few, many = figures
    which = {None: "short runs", 1: "one long drive"}.get(drives, f"{drives} long drives")
    rows = f"{many:,} rows in {which}"
    for what, (cpu_s, took_s, peak_mib) in figures[many].items():
        few_cpu_s, _, few_peak_mib = figures[few][what]
        print(
            f"\n{rows} {what}: {took_s:.0f} s, {cpu_s:.0f} s of CPU, {cpu_s / few_cpu_s:.1f} times those of "
            f"{few:,}; peak memory {peak_mib:,.0f} MiB, {peak_mib / few_peak_mib:.2f} times",
            end="",
        )
        assert peak_mib < 2e9 / 2**20
    print()
