"""What was written is read; faults of single rows are set aside and counted."""

import dataclasses
import logging

import numpy as np
import pyarrow.parquet
import pytest
from edits import edit_header, lines_of, replace_cell, write_lines

from drives import drive, header_of, write_drive
from swarmtwin.errors import UserError
from swarmtwin.recordings.reading import read_recording
from swarmtwin.recordings.writing import write_recording


@pytest.fixture
def mgr(robots):
    return robots["mgr"]


@pytest.fixture
def folder(mgr, tmp_path):
    """A clean recording: runs run_00000 and run_00001 of vehicles 1 and 2, five ticks each."""
    return write_drive(tmp_path / "recording", mgr, drive(mgr, runs=2, steps=4))


@pytest.mark.parametrize("name", ["mgr", "mur", "create"])
@pytest.mark.parametrize("file_format", ["csv", "parquet", "one_file"])
def test_what_was_written_is_read_up_to_the_stated_rounding(robots, name, file_format, tmp_path):
    robot = robots[name]
    tracks = drive(robot, runs=3, steps=20, vehicles=("02", "2", "drone seven"))
    tracks[1].pose[4:6] = np.nan
    tracks[2].command[7] = np.nan
    recording = read_recording(write_drive(tmp_path / "recording", robot, tracks, file_format), robot)
    assert recording.vehicles == ("02", "2", "drone seven")
    assert recording.runs == ("run_00000", "run_00001", "run_00002")
    assert [(track.run, track.vehicle) for track in recording.tracks] == [(t.run, t.vehicle) for t in tracks]
    for written, read in zip(tracks, recording.tracks, strict=True):
        np.testing.assert_allclose(read.time_s, written.time_s, rtol=0, atol=0.000501)
        np.testing.assert_allclose(read.command, written.command, rtol=0, atol=0.000000501)
        np.testing.assert_allclose(read.pose[:, :2], written.pose[:, :2], rtol=0, atol=0.000501)
        np.testing.assert_allclose(read.pose[:, 2], written.pose[:, 2], rtol=0, atol=0.00000501)


def test_writing_what_was_read_changes_nothing(mgr, folder, tmp_path):
    first = read_recording(folder, mgr)
    again = tmp_path / "again"
    again.mkdir()
    write_recording(again, mgr, first.header, first.tracks)
    assert read_recording(again, mgr).digest == first.digest
    assert (again / "recording.yaml").read_text() == (folder / "recording.yaml").read_text()


def assert_same_tracks(one, other):
    for first, second in zip(one.tracks, other.tracks, strict=True):
        assert (first.run, first.vehicle) == (second.run, second.vehicle)
        assert np.array_equal(first.pose, second.pose, equal_nan=True)
        assert np.array_equal(first.command, second.command, equal_nan=True)


@pytest.mark.parametrize("file_format", ["parquet", "one_file"])
def test_csv_and_parquet_hold_the_same(mgr, tmp_path, file_format):
    tracks = drive(mgr)
    csv = read_recording(write_drive(tmp_path / "csv", mgr, tracks, "csv"), mgr)
    parquet = read_recording(write_drive(tmp_path / "parquet", mgr, tracks, file_format), mgr)
    assert_same_tracks(csv, parquet)


def test_many_runs_are_one_file_and_few_are_files_of_their_own(mgr, tmp_path):
    few, many = drive(mgr, runs=99, steps=2), drive(mgr, runs=100, steps=2)
    assert len(list((write_drive(tmp_path / "few", mgr, few, None) / "runs").iterdir())) == 99
    folder = write_drive(tmp_path / "many", mgr, many, None)
    assert sorted(file.name for file in folder.iterdir() if file.suffix in (".yaml", ".parquet")) == [
        "recording.yaml",
        "runs.parquet",
    ]
    assert_same_tracks(read_recording(folder, mgr), read_recording(write_drive(tmp_path / "csv", mgr, many), mgr))


def test_a_run_may_end_in_a_later_row_group_than_it_begins_in(mgr, tmp_path):
    folder = write_drive(tmp_path / "recording", mgr, drive(mgr, runs=5, steps=7), "one_file")
    before = read_recording(folder, mgr)
    table = pyarrow.parquet.read_table(folder / "runs.parquet")
    for rows in (1, 3, 8, 13):
        pyarrow.parquet.write_table(table, folder / "runs.parquet", row_group_size=rows)
        assert_same_tracks(read_recording(folder, mgr), before)


def test_written_rows_are_short(folder):
    time_s, vehicle, left, right, x_mm, y_mm, heading_rad = lines_of(folder)[1].split(",")
    assert (time_s, vehicle) == ("0", "1")
    assert all(len(cell.partition(".")[2]) <= 3 for cell in (left, right, x_mm, y_mm))
    assert len(heading_rad.partition(".")[2]) <= 5
    assert lines_of(folder)[-1].split(",")[2:4] == ["", ""]


def test_headings_are_wrapped(mgr, folder):
    replace_cell(folder, 2, "heading_rad", "7.0")
    assert read_recording(folder, mgr).tracks[0].pose[0, 2] == pytest.approx(7 - 2 * np.pi)


def test_rows_of_vehicles_may_interleave_in_any_way(mgr, folder):
    clean = read_recording(folder, mgr)
    header, *rows = lines_of(folder)
    write_lines(folder, [header, *sorted(rows, key=lambda row: row.split(",")[1], reverse=True)])
    for one, other in zip(clean.tracks, read_recording(folder, mgr).tracks, strict=True):
        assert (one.run, one.vehicle) == (other.run, other.vehicle)
        assert np.array_equal(one.pose, other.pose)


def test_what_spreadsheets_do_to_a_file_does_no_harm(mgr, folder):
    clean = read_recording(folder, mgr)
    header, *rows = lines_of(folder)
    quoted = [f'"{cell}"' for cell in header.split(",")]
    text = "\r\n".join([",".join([*quoted[::-1]]), "", *(",".join(row.split(",")[::-1]) for row in rows), "", ""])
    (folder / "runs" / "run_00000.csv").write_text(text, encoding="utf-8-sig", newline="")
    for one, other in zip(clean.tracks, read_recording(folder, mgr).tracks, strict=True):
        assert np.array_equal(one.pose, other.pose)
        assert np.array_equal(one.command, other.command, equal_nan=True)


def test_the_digest_tells_contents_apart_and_nothing_else(mgr, folder, tmp_path):
    digest = read_recording(folder, mgr).digest
    moved = folder.rename(tmp_path / "elsewhere")
    edit_header(moved, notes="another note")
    assert read_recording(moved, mgr).digest == digest
    replace_cell(moved, 3, "x_mm", "500.0")
    assert read_recording(moved, mgr).digest != digest


def test_reading_leaves_the_recording_as_it_is(mgr, folder):
    before = {file: (file.read_bytes(), file.stat().st_mtime_ns) for file in folder.rglob("*") if file.is_file()}
    read_recording(folder, mgr)
    assert before == {
        file: (file.read_bytes(), file.stat().st_mtime_ns) for file in folder.rglob("*") if file.is_file()
    }


def test_a_date_may_stand_without_quotation_marks(mgr, folder):
    file = folder / "recording.yaml"
    file.write_text(file.read_text() + "started_at: 2024-05-01 10:30:00\n")
    assert read_recording(folder, mgr).header.started_at == "2024-05-01 10:30:00"


@pytest.mark.parametrize(
    ("run", "vehicle"), [("a/b", "1"), (".hidden", "1"), ("run", "a,b"), ("run", " "), ("run", '"')]
)
def test_names_that_the_format_cannot_hold_are_refused(mgr, tmp_path, run, vehicle):
    track = dataclasses.replace(drive(mgr)[0], run=run, vehicle=vehicle)
    with pytest.raises(UserError, match=r"^(run|vehicle) '.*' cannot be .*: use letters, digits, '_' and '-'$"):
        write_recording(tmp_path, mgr, header_of(mgr), [track])


def test_rows_set_aside_are_counted_by_reason_and_logged_in_one_line(mgr, folder, caplog):
    lines = lines_of(folder)
    replace_cell(folder, 3, "left", "inf")
    lines = lines_of(folder)
    lines.insert(5, lines[4])
    file = write_lines(folder, lines)
    lines = lines_of(folder, 1)
    lines[6] = "," + lines[6].partition(",")[2]
    file = write_lines(folder, lines, run=1)
    file.write_text(file.read_text()[:-4])
    with caplog.at_level(logging.WARNING):
        recording = read_recording(folder, mgr)
    counts = {"duplicate_row": 1, "impossible_value": 1, "no_time": 1, "truncated_row": 1}
    assert dict(recording.dropped_rows) == counts
    listed = "duplicate_row 1, impossible_value 1, no_time 1, truncated_row 1"
    assert caplog.messages == [f"{folder}: rows set aside while reading: {listed}"]
    assert [len(track) for track in recording.tracks] == [5, 5, 5, 3]


def test_the_command_before_a_row_without_time_is_unknown(mgr, folder):
    clean = read_recording(folder, mgr).tracks[0]
    replace_cell(folder, 6, "time_s", "")
    track = read_recording(folder, mgr).tracks[0]
    assert np.array_equal(track.time_s, np.delete(clean.time_s, 2))
    assert np.isnan(track.command[1]).all()
    assert np.array_equal(track.pose, np.delete(clean.pose, 2, axis=0))


def test_half_a_pose_is_none(mgr, folder):
    replace_cell(folder, 4, "y_mm", "")
    assert np.isnan(read_recording(folder, mgr).tracks[0].pose[1]).all()


def test_columns_and_files_that_nothing_reads_are_told(mgr, folder, caplog):
    write_lines(folder, [f"{line},{'battery_v' if row == 0 else '3.7'}" for row, line in enumerate(lines_of(folder))])
    (folder / "runs" / "notes.txt").write_text("sunny")
    (folder / "runs" / ".DS_Store").write_text("")
    with caplog.at_level(logging.WARNING):
        read_recording(folder, mgr)
    assert caplog.messages == [
        f"{folder}/runs: notes.txt left unread, no .csv or .parquet",
        f"{folder}: columns that nothing reads: battery_v",
    ]


def test_runs_that_overlap_in_time_are_told(mgr, tmp_path, caplog):
    tracks = [dataclasses.replace(track, time_s=track.time_s % 7) for track in drive(mgr, steps=4)]
    folder = write_drive(tmp_path / "recording", mgr, tracks)
    with caplog.at_level(logging.WARNING):
        read_recording(folder, mgr)
    assert caplog.messages == [
        f"{folder}: vehicle '1' drives in runs 'run_00000' and 'run_00001' at the same time: "
        "count times from the start of the session"
    ]


def test_a_clock_that_was_set_back_between_runs_is_told(mgr, tmp_path):
    tracks = drive(mgr, runs=12, steps=4, vehicles=("1",))
    set_back = [dataclasses.replace(track, time_s=track.time_s - 7200) for track in tracks[6:]]
    recording = read_recording(write_drive(tmp_path / "recording", mgr, [*tracks[:6], *set_back]), mgr)
    first_s = set_back[0].time_s[0]
    assert recording.warnings == (
        f"by their times run 'run_00006' begins {tracks[5].time_s[0] - first_s:,.0f} s before run 'run_00005': was the "
        "clock set back between them? count times from the start of the session",
        f"times begin at {first_s:,.0f} s, below zero: count times from the start of the session",
    )


def test_names_of_runs_that_are_in_no_order_of_time_say_nothing_of_the_clock(mgr, tmp_path):
    tracks = drive(mgr, runs=12, steps=4, vehicles=("1",))
    order = np.random.default_rng(1).permutation(12)
    mixed = [dataclasses.replace(track, run=f"run_{place:05}") for track, place in zip(tracks, order, strict=True)]
    assert read_recording(write_drive(tmp_path / "recording", mgr, mixed), mgr).warnings == ()
