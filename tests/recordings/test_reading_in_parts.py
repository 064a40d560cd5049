"""A recording that is read in parts is the one that is read whole: its rows, its faults and what it is judged by."""

import dataclasses

import numpy as np
import pyarrow.parquet
import pytest
import whole_recordings
from hypothesis import given, settings
from hypothesis import strategies as st

from drives import drive, write_drive
from swarmtwin.errors import UserError
from swarmtwin.recordings.even_sample import EvenSample
from swarmtwin.recordings.plausibility.judgement import judge
from swarmtwin.recordings.plausibility.sampled_rows import SampledRows
from swarmtwin.recordings.reading import read_in_parts, read_recording
from swarmtwin.standin.physics import Physics


@pytest.fixture
def mgr(robots):
    return robots["mgr"]


def in_parts(folder, robot, rows):
    parts = []
    return read_in_parts(folder, robot, parts.append, rows), parts


@given(st.lists(st.integers(0, 40), min_size=1), st.integers(1, 20))
@settings(deadline=None, derandomize=True)
def test_what_is_kept_does_not_depend_on_the_pieces_it_comes_in(pieces, most):
    passing = np.arange(sum(pieces))
    sample, whole, first = EvenSample(most), EvenSample(most), 0
    for count in pieces:
        sample.add(count, passing[first : first + count][sample.due(count)])
        first += count
    whole.add(first, passing[whole.due(first)])
    (kept,) = sample.columns()
    np.testing.assert_array_equal(kept, whole.columns()[0])
    assert sample.seen == first
    assert len(kept) <= most
    if first <= most:
        np.testing.assert_array_equal(kept, passing)
    else:
        assert len(kept) >= most // 2
        assert len(set(np.diff(kept))) <= 1


@pytest.mark.parametrize("file_format", ["csv", "parquet", "one_file"])
@pytest.mark.parametrize("runs", [1, 3, 7, 8, 30])
@pytest.mark.parametrize("rows", [1, 100, 500, 10**6])
def test_the_parts_make_up_the_whole(mgr, tmp_path, file_format, runs, rows):
    folder = write_drive(tmp_path / "recording", mgr, drive(mgr, runs, 99, vehicles=("2", "1")), file_format)
    whole, (about, parts) = read_recording(folder, mgr), in_parts(folder, mgr, rows)
    assert dataclasses.replace(whole, tracks=()) == about
    tracks = [track for part in parts for track in part.tracks]
    for track, expected in zip(tracks, whole.tracks, strict=True):
        assert (track.run, track.vehicle) == (expected.run, expected.vehicle)
        assert track.digest() == expected.digest()
    seen = [run for part in parts for run in part.runs]
    assert seen == list(whole.runs)  # no run is in two parts
    in_a_part = [sum(map(len, part.tracks)) for part in parts]
    longest_run = max(sum(len(track) for track in whole.tracks if track.run == run) for run in whole.runs)
    assert max(in_a_part) < rows + 8 * longest_run
    assert len(parts) == 1 or rows < 10**6


def test_a_group_of_many_rows_is_read_in_pieces(mgr, tmp_path, monkeypatch):
    folder = write_drive(tmp_path / "recording", mgr, drive(mgr, runs=20, steps=30), "one_file")
    expected = [track.digest() for track in read_recording(folder, mgr).tracks]
    largest = []
    iter_batches = pyarrow.parquet.ParquetFile.iter_batches

    def in_pieces(self, most, **options):
        for batch in iter_batches(self, 17, **options):
            largest.append(len(batch))
            yield batch

    monkeypatch.setattr(pyarrow.parquet.ParquetFile, "iter_batches", in_pieces)
    assert [track.digest() for track in read_recording(folder, mgr).tracks] == expected
    assert max(largest) == 17


@pytest.mark.parametrize("place", [0.2, 0.5, 0.8])
def test_a_fault_in_the_middle_is_the_error_it_is_when_read_whole(mgr, tmp_path, place):
    folder = write_drive(tmp_path / "recording", mgr, drive(mgr, runs=40, steps=20, vehicles=("1",)), "one_file")
    file = folder / "runs.parquet"
    table = pyarrow.parquet.read_table(file)
    row = int(place * len(table)) // 21 * 21 + 5
    time_s = table["time_s"].to_numpy().copy()
    time_s[row] = time_s[row - 2]
    pyarrow.parquet.write_table(table.set_column(1, "time_s", [time_s]), file, row_group_size=50)
    with pytest.raises(UserError) as whole:
        read_recording(folder, mgr)
    with pytest.raises(UserError) as parted:
        in_parts(folder, mgr, 60)
    assert str(parted.value) == str(whole.value)
    assert str(whole.value).startswith(f"{file}, row {row + 1}, column 'time_s': vehicle '1' goes back in time")


@pytest.mark.parametrize("rows", [100, 10**6])
def test_a_run_without_a_name_is_told_by_its_row(mgr, tmp_path, rows):
    folder = write_drive(tmp_path / "recording", mgr, drive(mgr, runs=40, steps=20, vehicles=("1",)), "one_file")
    file = folder / "runs.parquet"
    table = pyarrow.parquet.read_table(file)
    for nameless in ("", "  ", None):
        names = table["run"].to_pylist()
        names[500] = nameless
        changed = table.set_column(0, "run", [pyarrow.array(names, pyarrow.string())])
        pyarrow.parquet.write_table(changed, file, row_group_size=64)
        with pytest.raises(UserError) as refused:
            in_parts(folder, mgr, rows)
        assert str(refused.value) == f"{file}, row 501, column 'run': no run is named: write the run's name"


@pytest.fixture(scope="module")
def _quick_stand_ins():
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(Physics, "bank_rows", 2048)
        yield


def verdict(recording, most):
    """What an even part of a recording, taken run by run, is judged to be: refused, or the warnings' beginnings."""
    rows = SampledRows(recording.robot, most_pairs=most, most_rows=most)
    for run in recording.runs:
        rows.add([track for track in recording.tracks if track.run == run])
    assert len(rows.position()) <= most
    try:
        return judge(recording.header, rows)
    except UserError as error:
        return str(error).partition("?")[0].split(": ")[-1]


@pytest.mark.usefixtures("_quick_stand_ins")
@pytest.mark.parametrize("robot", ["mgr", "mur", "create"])
def test_an_even_part_of_the_rows_is_judged_as_all_of_them(robot):
    """Mistakes are named by an even part of the rows as they are by all of them, but where they are near the limits."""
    agreed = []
    for _, recording in whole_recordings.mistaken():
        if recording.robot.name == robot and max(np.abs(track.pose[:, 2]).max() for track in recording.tracks) < 7:
            everything = verdict(recording, 10**6)
            if isinstance(everything, str):  # a refusal
                agreed.append(verdict(recording, 250) == everything)
    assert len(agreed) > 10
    assert np.mean(agreed) > 0.95
