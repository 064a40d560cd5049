"""`swarmtwin import` leaves a recording that `prepare` takes, or nothing at all."""

import numpy as np
import pytest
import yaml

from swarmtwin.commands import import_recording
from swarmtwin.errors import UserError
from swarmtwin.recordings.reading import read_recording
from swarmtwin.robot import Arena

EPOCH_S = 1_248_444_175.0


@pytest.fixture
def data_set(tmp_path):
    """Robots 1 and 2 drive straight on for 20 s at 50 mm/s."""
    folder = tmp_path / "data_set"
    folder.mkdir()
    time_s = np.arange(0, 20, 0.02)
    for number in (1, 2):
        command = np.column_stack([EPOCH_S + time_s, np.full_like(time_s, 0.05), np.zeros_like(time_s)])
        pose = np.column_stack([EPOCH_S + time_s, 0.05 * time_s, np.full_like(time_s, number), np.zeros_like(time_s)])
        np.savetxt(folder / f"Robot{number}_Odometry.dat", command, fmt="%.3f")
        np.savetxt(folder / f"Robot{number}_Groundtruth.dat", pose, fmt="%.6f")
    return folder


@pytest.fixture
def options(robots, data_set, tmp_path):
    """The options of an import, as a command line gives them: numbers for ids, text for paths."""

    def with_changes(**changes):
        chosen = {
            "robot": robots["create"].model_dump(),
            "source": {"name": "mrclam"},
            "path": str(data_set),
            "vehicles": None,
            "run_s": 5,
            "output": str(tmp_path / "recording"),
            "format": "csv",
            "overwrite": False,
        }
        return import_recording.Options.parse(chosen | changes, "swarmtwin import")

    return with_changes


@pytest.mark.parametrize("file_format", ["csv", "parquet"])
def test_an_imported_recording_can_be_read(robots, options, tmp_path, file_format):
    import_recording.run(options(format=file_format))
    recording = read_recording(tmp_path / "recording", robots["create"])
    assert recording.runs == ("run_0001", "run_0002", "run_0003", "run_0004")
    assert recording.vehicles == ("1", "2")
    assert recording.header.arena_mm == Arena(x=(-1000, 6000), y=(-5000, 7000))
    for track in recording.tracks:
        np.testing.assert_allclose(track.pose[:, 0], 50 * track.time_s, atol=0.01)
        np.testing.assert_allclose(track.command[:-1], [[50.0, 0.0]] * (len(track) - 1), atol=1e-6)


@pytest.mark.parametrize(("vehicles", "ids"), [(2, ["2"]), ([1, 2], ["1", "2"]), (["2"], ["2"]), ("1", ["1"])])
def test_vehicles_are_chosen_as_a_command_line_writes_them(options, tmp_path, vehicles, ids):
    import_recording.run(options(vehicles=vehicles))
    assert yaml.safe_load((tmp_path / "recording" / "recording.yaml").read_text())["vehicles"] == ids


def test_importing_twice_gives_the_same_bytes(robots, options, tmp_path):
    import_recording.run(options())
    import_recording.run(options(output=str(tmp_path / "again")))
    first, again = (read_recording(tmp_path / name, robots["create"]) for name in ("recording", "again"))
    assert first.digest == again.digest


def test_the_table_counts_by_vehicle(options, capsys):
    import_recording.run(options())
    shown = capsys.readouterr().out
    assert "iRobot Create: 4 runs" in shown
    rows = [[cell.strip() for cell in line.split("│")[1:-1]] for line in shown.splitlines() if line.startswith("│")]
    assert rows == [["1", "4", "43", "39"], ["2", "4", "43", "39"], ["all", "8", "86", "78"]]


def test_an_unknown_source_is_refused(options, tmp_path):
    with pytest.raises(UserError) as refused:
        import_recording.run(options(source={"name": "mrclan"}))
    assert str(refused.value) == "no such source: 'mrclan': did you mean 'mrclam'? known: mrclam"


def test_what_goes_wrong_leaves_nothing_behind(options, data_set, tmp_path):
    (data_set / "Robot2_Groundtruth.dat").write_text("1 2 x 4\n")
    with pytest.raises(UserError, match=r"Robot2_Groundtruth.dat, row 1, column 'y': 'x' is not a number"):
        import_recording.run(options())
    assert sorted(path.name for path in tmp_path.iterdir()) == ["data_set"]


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"run_s": "inf"}, "field 'run_s': Input should be a finite number, got 'inf'"),
        ({"run_s": 1e-9}, "field 'content': Value error, run_s 1e-09 is too short: give at least two periods, 1"),
        ({"run_s": 0.9}, "field 'content': Value error, run_s 0.9 is too short: give at least two periods, 1"),
        ({"run_s": -5}, "field 'content': Value error, run_s -5 is too short: give at least two periods, 1"),
        ({"run_s": 90_000}, "field 'run_s': Input should be less than or equal to 86400, got 90000"),
        ({"vehicles": []}, "field 'vehicles': Tuple should have at least 1 item after validation, not 0, got []"),
    ],
)
def test_options_that_make_no_sense_are_refused(options, changes, message):
    with pytest.raises(UserError) as refused:
        options(**changes)
    assert str(refused.value) == f"swarmtwin import: {message}"


@pytest.mark.parametrize("run_s", [1, 86_400])
def test_runs_may_be_two_periods_or_a_day_long(options, run_s):
    assert options(run_s=run_s).run_s == run_s


@pytest.mark.parametrize("time", ["1e18", "-1e300", "1248544175"])
@pytest.mark.parametrize("name", ["Robot1_Odometry.dat", "Robot2_Groundtruth.dat"])
def test_a_time_that_cannot_be_is_told_with_its_row(options, data_set, tmp_path, name, time):
    file = data_set / name
    lines = ["# Time [s]", *file.read_text().splitlines()]
    lines[7] = " ".join([time, *lines[7].split()[1:]])
    file.write_text("\n".join(lines) + "\n")
    with pytest.raises(UserError) as refused:
        import_recording.run(options())
    assert str(refused.value) == (
        f"{file}, row 8, column 'time': time {float(time):g} s is more than a day from most others, or beyond the year "
        "2100: copy the file again from the data set"
    )
    assert not (tmp_path / "recording").exists()


def test_times_that_are_all_wrong_are_refused(options, data_set):
    file = data_set / "Robot1_Groundtruth.dat"
    file.write_text("".join(f"1e18 {line.partition(' ')[2]}" for line in file.read_text().splitlines(keepends=True)))
    with pytest.raises(UserError, match=r"Robot1_Groundtruth.dat, row 1, column 'time': time 1e\+18 s"):
        import_recording.run(options())


def test_robots_of_different_sessions_are_refused(options, data_set):
    for kind in ("Odometry", "Groundtruth"):
        file = data_set / f"Robot2_{kind}.dat"
        values = np.loadtxt(file)
        values[:, 0] += 10 * 86_400
        np.savetxt(file, values, fmt="%.6f")
    with pytest.raises(UserError) as refused:
        import_recording.run(options())
    assert str(refused.value) == (
        f"{data_set}: the robots' poses were measured up to 10.0 days apart: use files of one and the same data set"
    )
