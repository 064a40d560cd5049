"""Long runs of a recording that has few are taken as several; what has enough runs stays as it is."""

import dataclasses

import numpy as np
import pandas as pd
import pytest

from drives import drive, header_of, write_drive
from swarmtwin.diagnosis.measured_session import MeasuredSession
from swarmtwin.diagnosis.reference import conditions_of, require_enough
from swarmtwin.diagnosis.settings import ReferenceSettings
from swarmtwin.errors import UserError
from swarmtwin.recordings.blocks import in_blocks, run_of, table_in_blocks
from swarmtwin.recordings.reading import read_recording
from swarmtwin.recordings.recording import Recording
from swarmtwin.transitions import SPLITS, from_recording, split_by_run
from swarmtwin.transitions.splitting import Fractions


@pytest.fixture
def mgr(robots):
    return robots["mgr"]


def found_in(transitions, others):
    """Where each of the transitions stands among others, by vehicle and time."""
    times = {(others.vehicle[row], others.time_s[row]): row for row in range(len(others))}
    return np.array([times[key] for key in zip(transitions.vehicle, transitions.time_s, strict=True)])


@pytest.mark.parametrize("vehicles", [("1",), ("1", "2", "3")])
def test_a_single_drive_is_a_session(mgr, vehicles, tmp_path):
    tracks = drive(mgr, runs=1, steps=900, vehicles=vehicles)
    recording = read_recording(write_drive(tmp_path / "one", mgr, tracks), mgr)
    assert len(recording.runs) == 22  # of at least 40 periods
    assert {run_of(name) for name in recording.runs} == {"run_00000"}
    transitions, _ = from_recording(recording)
    require_enough(MeasuredSession.of(transitions, conditions_of(transitions)), ReferenceSettings(), "measured")
    split = split_by_run(transitions, Fractions(train=0.8, validation=0.1, test=0.1), seed=1)
    assert set(split.split) == {0, 1, 2}
    assert np.bincount(split.split, minlength=len(SPLITS)).min() > 0.05 * len(split)


def test_blocks_share_no_measurement_and_lose_only_their_seams(mgr, tmp_path):
    tracks = drive(mgr, runs=1, steps=900, vehicles=("1", "2"))
    recording = read_recording(write_drive(tmp_path / "one", mgr, tracks), mgr)
    cut, _ = from_recording(recording)
    whole, _ = from_recording(dataclasses.replace(recording, tracks=tuple(tracks)))
    row = found_in(cut, whole)
    assert len(whole) - len(cut) == 2 * (len(recording.runs) - 1)
    rounding = 5e-3  # what is written has three decimals, and headings turn what is 300 mm away
    np.testing.assert_allclose(cut.displacement, whole.displacement[row], atol=rounding)
    np.testing.assert_allclose(cut.neighbours, whole.neighbours[row], atol=rounding)
    began = np.flatnonzero(np.isnan(cut.previous_command).any(axis=1))
    assert len(began) == 2 * len(recording.runs)
    assert (cut.just_before()[began] == -1).all()
    rows = {(track.vehicle, time_s) for track in recording.tracks for time_s in track.time_s.round(3)}
    assert len(rows) == sum(map(len, recording.tracks))  # every row is in one block alone


def test_of_few_runs_the_long_ones_are_cut(mgr):
    tracks = [*drive(mgr, runs=3, steps=400, vehicles=("1",)), *drive(mgr, runs=1, steps=30, vehicles=("1",))]
    tracks[-1] = dataclasses.replace(tracks[-1], run="short")
    blocks = in_blocks(tracks)
    assert [sum(run_of(block.run) == name for block in blocks) for name in ("run_00000", "run_00001")] == [10, 10]
    assert blocks[-1] is tracks[-1]
    assert all(40 <= len(block) <= 41 for block in blocks[:-1])


def test_what_has_enough_runs_stays_as_it_is(mgr):
    tracks = tuple(drive(mgr, runs=8, steps=100))
    assert all(block is track for block, track in zip(in_blocks(tracks), tracks, strict=True))


def test_of_some_runs_the_long_ones_are_cut_where_more_are_wanted(mgr):
    tracks = tuple(drive(mgr, runs=8, steps=210, vehicles=("1",)))
    blocks = in_blocks(tracks, fewest=40)
    assert len(blocks) == 8 * 5
    assert in_blocks(blocks, fewest=40) == blocks


def session(mgr, runs, steps):
    """What is measured of whole runs."""
    transitions, _ = from_recording(Recording(mgr, header_of(mgr), tuple(drive(mgr, runs=runs, steps=steps))))
    return MeasuredSession.of(transitions, conditions_of(transitions))


def test_a_part_of_many_runs_is_spread_over_them_and_keeps_step_with_nothing(mgr):
    short = session(mgr, runs=60, steps=30)
    assert short.spread_over(len(short)).all()
    chosen = short.spread_over(len(short) // 3)
    assert len(short) / 3 <= chosen.sum() < 1.1 * len(short) / 3
    runs = np.unique(short.run[chosen])
    assert set(runs).isdisjoint(short.run[~chosen])
    assert np.diff(runs).max() <= 5
    for every in (2, 3, 4):  # other drives in turn, and runs held out
        assert np.bincount(runs % every, minlength=every).min() >= 0.6 * len(runs) / every


def test_a_part_has_as_many_runs_as_any_conclusion_takes(mgr):
    few = session(mgr, runs=12, steps=30)
    assert len(np.unique(few.run[few.spread_over(10)])) == 8


def test_a_part_of_one_long_run_is_of_all_of_it(mgr):
    long = session(mgr, runs=1, steps=6000)
    chosen = long.spread_over(3000)
    assert 0.8 * 3000 < chosen.sum() < 1.2 * 3000
    progress = long.transitions.time_s[chosen] / long.transitions.time_s.max()
    assert np.histogram(progress, 4, (0.0, 1.0))[0].min() > 500


def test_runs_that_are_few_beside_empty_ones_are_cut(mgr, tmp_path):
    folder = write_drive(tmp_path / "one", mgr, drive(mgr, runs=7, steps=300, vehicles=("1",)))
    expected = read_recording(folder, mgr)
    rows = pd.read_csv(folder / "runs" / "run_00000.csv").head(5)
    rows["time_s"] = np.nan  # no row of these is complete
    for number in range(90, 93):
        rows.to_csv(folder / "runs" / f"run_000{number}.csv", index=False)
    found = read_recording(folder, mgr)
    assert found.runs == expected.runs
    assert len(found.runs) > 7


@pytest.fixture
def at_most_100_rows(monkeypatch):
    monkeypatch.setitem(table_in_blocks.__kwdefaults__, "most_rows", 100)


@pytest.mark.usefixtures("at_most_100_rows")
@pytest.mark.parametrize("file_format", ["csv", "parquet", "one_file"])
@pytest.mark.parametrize("runs", [1, 9])
def test_a_run_of_many_rows_is_cut_however_many_there_are(mgr, tmp_path, file_format, runs):
    tracks = drive(mgr, runs=runs, steps=399, vehicles=("2", "1"))
    recording = read_recording(write_drive(tmp_path / "long", mgr, tracks, file_format), mgr)
    assert max(sum(len(track) for track in recording.tracks if track.run == run) for run in recording.runs) <= 100
    assert [run_of(name) for name in recording.runs] == sorted(run_of(name) for name in recording.runs)
    for whole in tracks:
        own = [track for track in recording.tracks if (run_of(track.run), track.vehicle) == (whole.run, whole.vehicle)]
        assert len(own) >= 8
        together = (np.concatenate([getattr(track, name) for track in own]) for name in ("time_s", "command", "pose"))
        joined = dataclasses.replace(whole, **dict(zip(("time_s", "command", "pose"), together, strict=True)))
        np.testing.assert_allclose(joined.time_s, whole.time_s, atol=1e-3)
        np.testing.assert_allclose(joined.command, whole.command, atol=1e-3)
        np.testing.assert_allclose(joined.pose, whole.pose, atol=1e-3)


@pytest.mark.usefixtures("at_most_100_rows")
@pytest.mark.parametrize("row", [3, 250, 391])
def test_a_fault_in_a_run_that_is_cut_is_told_by_its_row_in_the_file(mgr, tmp_path, row):
    folder = write_drive(tmp_path / "long", mgr, drive(mgr, runs=1, steps=399, vehicles=("1",)), "parquet")
    file = next((folder / "runs").iterdir())
    table = pd.read_parquet(file)
    table.loc[row, "time_s"] = table.loc[row - 2, "time_s"]
    table.to_parquet(file, index=False)
    with pytest.raises(UserError, match=f"row {row + 1}, column 'time_s': vehicle '1' goes back in time"):
        read_recording(folder, mgr)
    table.loc[row, "time_s"] = table.loc[row - 1, "time_s"]
    table.to_parquet(file, index=False)
    with pytest.raises(UserError, match=f"row {row + 1}, column 'vehicle': vehicle '1' has two different rows"):
        read_recording(folder, mgr)


@pytest.mark.usefixtures("at_most_100_rows")
def test_a_row_without_time_stays_with_the_one_before(mgr, tmp_path):
    folder = write_drive(tmp_path / "long", mgr, drive(mgr, runs=1, steps=399, vehicles=("1", "2")), "parquet")
    file = next((folder / "runs").iterdir())
    table = pd.read_parquet(file)
    rows = np.flatnonzero(table.vehicle == "2")[[0, 130, 131, 260]]
    table.loc[rows, "time_s"] = np.nan
    table.to_parquet(file, index=False)
    recording = read_recording(folder, mgr)
    assert recording.dropped_rows == {"no_time": 4}
    second = [track for track in recording.tracks if track.vehicle == "2"]
    unknown = np.concatenate([np.isnan(track.command).any(axis=1) for track in second])
    assert np.flatnonzero(unknown).tolist() == [128, 256, 395]  # those before, and the last
