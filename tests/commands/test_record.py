import csv
import re

import numpy as np
import pandas as pd
import pytest
import yaml

from swarmtwin.commands.app import config_folder
from swarmtwin.commands.record import Options, run
from swarmtwin.errors import UserError
from swarmtwin.recordings.exact_means import EXACT_MEANS_FILE, read_exact_means
from swarmtwin.recordings.reading import read_recording
from swarmtwin.standin.effects import catalogue
from swarmtwin.standin.physics import Physics
from swarmtwin.standin.session import StandInSession
from swarmtwin.studies.stand_in_recording import record as record_session
from swarmtwin.transitions import from_recording


@pytest.fixture(autouse=True)
def small_bank(monkeypatch):
    monkeypatch.setattr(Physics, "bank_rows", 2048)


@pytest.fixture
def record(robots, tmp_path):
    """Run the command with its defaults, fewer runs, and what is given; return the recording's folder."""
    defaults = yaml.safe_load((config_folder() / "record.yaml").read_text())

    def call(robot="mgr", output="recording", **given):
        content = {key: value for key, value in defaults.items() if key != "defaults"}
        content |= {"robot": robots[robot], "runs": 4, "steps": 6, "output": tmp_path / output, **given}
        run(Options.parse(content, "swarmtwin record"))
        return tmp_path / output

    return call


@pytest.mark.parametrize("robot", ["mgr", "mur"])
def test_a_rigid_body_is_recorded_alike_without_exact_means_that_nobody_knows(record, robots, robot):
    folder = record(robot, engine="rigid_body", lost_poses=0)
    recording = read_recording(folder, robots[robot])
    assert from_recording(recording)[1].kept == 24
    formulas = record(robot, "by_formulas", lost_poses=0)
    names, by_formulas = ({path.name for path in each.iterdir()} for each in (folder, formulas))
    assert by_formulas - names == {EXACT_MEANS_FILE}
    assert (folder / "recording.yaml").read_text() == (formulas / "recording.yaml").read_text()


@pytest.mark.parametrize("robot", ["mgr", "mur"])
@pytest.mark.parametrize("file_format", ["csv", "parquet"])
def test_what_is_recorded_is_read_without_complaint(record, robots, robot, file_format):
    recording = read_recording(record(robot, format=file_format, lost_poses=0), robots[robot])
    _, counts = from_recording(recording)
    assert recording.runs == ("run_0001", "run_0002", "run_0003", "run_0004")
    assert not recording.dropped_rows
    assert counts.rows == 28
    assert counts.considered == 24


def test_the_last_row_of_a_run_has_the_pose_reached_and_no_command(record):
    with (record() / "runs" / "run_0002.csv").open() as file:
        rows = list(csv.DictReader(file))
    assert len(rows) == 7
    assert all(row["left"] and row["right"] for row in rows[:-1])
    assert rows[-1]["left"] == rows[-1]["right"] == ""
    assert rows[-1]["x_mm"] != ""
    assert rows[-1]["heading_rad"] != ""


def test_a_row_takes_about_45_bytes(record):
    files = list((record(runs=10, steps=40) / "runs").glob("*.csv"))
    assert 35 < sum(file.stat().st_size for file in files) / (10 * 41) < 50


def test_the_same_seed_writes_the_same_bytes(record):
    first, again, other = record(output="a"), record(output="b"), record(output="c", seed=2)
    for file in [*(first / "runs").iterdir(), first / "recording.yaml", first / "truth.parquet"]:
        relative = file.relative_to(first)
        assert file.read_bytes() == (again / relative).read_bytes()
    assert (first / "runs/run_0001.csv").read_bytes() != (other / "runs/run_0001.csv").read_bytes()


def test_nothing_in_a_recording_tells_that_an_effect_was_on(record):
    plain, changed = record(output="a"), record(output="b", effects=[{"name": "battery_sag", "loss": 0.77}])
    assert (plain / "recording.yaml").read_bytes() == (changed / "recording.yaml").read_bytes()
    assert {file.name for file in plain.rglob("*")} == {file.name for file in changed.rglob("*")}
    for file in changed.rglob("*"):
        if file.is_file():
            content = file.read_bytes()
            assert not [name for name in catalogue() if name.encode() in content]
            assert b"effect" not in content
            assert b"0.77" not in content or file.suffix == ".csv"


@pytest.mark.parametrize("wanted", [1, 37, 200])
def test_recording_goes_on_until_exactly_so_many_transitions_are_usable(record, robots, wanted):
    folder = record(transitions=wanted, lost_poses=0.1, effects=[{"name": "timing_jitter", "spread": 0.15}])
    recording = read_recording(folder, robots["mgr"])
    transitions, _ = from_recording(recording)
    assert len(transitions) == wanted
    assert np.isnan(recording.tracks[-1].command[-1]).all()
    assert not np.isnan(recording.tracks[-1].pose[-1]).any()


def test_every_recorded_command_has_its_answer(record, robots):
    for folder in (record(transitions=21, lost_poses=0.1), record(output="group", vehicle=[1, 2])):
        recording = read_recording(folder, robots["mgr"])
        rows = pd.DataFrame(
            [
                (track.run, track.vehicle, time_s)
                for track in recording.tracks
                for time_s, command in zip(track.time_s, track.command, strict=True)
                if not np.isnan(command).any()
            ],
            columns=["run", "vehicle", "time_s"],
        )
        answers = rows.merge(read_exact_means(folder), on=["run", "vehicle", "time_s"], how="outer", indicator=True)
        assert (answers["_merge"] == "both").all()
        assert answers.notna().all(axis=None)


def test_several_vehicles_share_a_run(record, robots):
    recording = read_recording(record(vehicle=[1, "b"]), robots["mgr"])
    assert recording.vehicles == ("1", "b")
    assert len(recording.tracks) == 8


def test_a_drive_is_played(record, robots, tmp_path):
    pd.DataFrame({"right": [50, 60, 70], "note": "x", "left": [-10, 0, 10]}).to_csv(tmp_path / "drive.csv", index=False)
    recording = read_recording(record(drive=tmp_path / "drive.csv", runs=20, steps=3), robots["mgr"])
    written = np.array([[-10, 50], [0, 60], [10, 70]])
    played = [np.array_equal(track.command[:3], written) for track in recording.tracks]
    assert np.mean(played) > 0.7


DRIVES = [
    ("left,rigth\n1,2\n", "column 'right' is missing: did you mean 'rigth'?"),
    ("left,right\n1,2\n1,130\n", "row 3: right is 130: write a number from -120 to 120 PWM"),
    ("left,right\n1,2\nfast,3\n", "row 3: left is fast: write a number from -120 to 120 PWM"),
    ("left,right\n", "holds no command: write one a row"),
    ("", "is no CSV file"),
]


@pytest.mark.parametrize(("text", "message"), DRIVES)
def test_a_drive_that_makes_no_sense_is_refused(record, tmp_path, text, message):
    drive = tmp_path / "drive.csv"
    drive.write_text(text)
    with pytest.raises(UserError, match=f"^drive {re.escape(str(drive))}.* ?{re.escape(message)}"):
        record(drive=drive)
    assert not (tmp_path / "recording").exists()


REFUSED = [
    ({"robot": "create"}, "robot 'create' has no stand-in: known: mgr, mur"),
    ({"vehicle": [1, 2, 1]}, "vehicle '1' is named twice: give each id once"),
    (
        {"vehicle": [1, 2], "transitions": 9},
        "transitions=... cuts the runs of one vehicle: give one vehicle, or runs=...",
    ),
    ({"vehicle": []}, "swarmtwin record: field 'vehicle': Value should have at least 1 item after validation, not 0"),
    (
        {"runs": 100_000_000, "steps": 1000},
        "a recording of 100,100,000,000 rows (100,000,000 runs of 1,000 steps, vehicles: 1) is too long: stay below "
        "20,000,000 rows, with several recordings if need be",
    ),
    (
        {"transitions": 30_000_000},
        "a recording of 35,000,000 rows (5,000,000 runs of 6 steps, vehicles: 1) is too long",
    ),
    ({"vehicle": list(range(9)), "runs": 60_000, "steps": 40}, "a recording of 22,140,000 rows (60,000 runs of 40"),
    ({"drive": "nowhere.csv"}, "drive nowhere.csv is missing: name a CSV file with left, right"),
    ({"runs": 0}, "swarmtwin record: field 'runs': Input should be greater than or equal to 1, got 0"),
    ({"effects": [{"name": "gain_chang"}]}, "effects: unknown effect 'gain_chang': did you mean 'gain_change'?"),
]


@pytest.mark.parametrize(("given", "message"), REFUSED)
def test_options_that_make_no_sense_are_refused(record, tmp_path, given, message):
    with pytest.raises(UserError, match=f"^{re.escape(message)}"):
        record(**given)
    assert not list(tmp_path.iterdir())


def test_a_drive_that_is_a_folder_is_refused(record, tmp_path):
    with pytest.raises(UserError) as refused:
        record(drive=tmp_path)
    assert str(refused.value) == f"drive {tmp_path} cannot be read (Is a directory): name a CSV file"


def test_recording_gives_up_when_too_few_transitions_are_usable(robots):
    session = StandInSession(robots["mgr"], vehicles=("1",), runs=100, steps=6, seed=1, lost_poses=0.9)
    with pytest.raises(UserError, match=r"vehicles: 1\) is too long: stay below 5,000 rows"):
        record_session(session, transitions=600, most_rows=5000)


def test_a_recording_is_not_replaced_unasked(record):
    record()
    with pytest.raises(UserError, match="already holds something"):
        record()
    record(overwrite=True)
