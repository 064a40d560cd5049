"""`swarmtwin track`: what is rendered from known poses becomes a recording of these poses, and `prepare` takes it."""

import cv2
import numpy as np
import pandas as pd
import pytest

from overhead import Scene, poses_at
from swarmtwin.commands import prepare, track
from swarmtwin.commands.inputs import check_inputs
from swarmtwin.deploy.tracking.calibration_fit import MeasuredByHand, fit_calibration
from swarmtwin.errors import UserError
from swarmtwin.geometry import residual_between
from swarmtwin.recordings.reading import read_recording

FRAMES_PER_S = 15
FRAMES = 5 * FRAMES_PER_S
HIDDEN = range(2 * FRAMES_PER_S, 5 * FRAMES_PER_S // 2)
COMMANDS_AHEAD_S = 100.0


@pytest.fixture(scope="module")
def drive(tmp_path_factory, robots):
    """A folder with pictures of five vehicles, 5 s at 15 a second, and a calibration from twelve pictures elsewhere."""
    folder = tmp_path_factory.mktemp("drive")
    scene = Scene(robots["mgr"])
    (folder / "pictures").mkdir()
    for number in range(FRAMES):
        picture = scene.picture(number / FRAMES_PER_S, hidden=("4",) if number in HIDDEN else ())
        cv2.imwrite(str(folder / "pictures" / f"{number:04}.png"), picture)
    times = pd.DataFrame({"file": [f"{number:04}.png" for number in range(FRAMES)]})
    times.assign(time_s=np.arange(FRAMES) / FRAMES_PER_S).to_csv(folder / "pictures" / "times.csv", index=False)
    fit_calibration(scene.pictures(), robots["mgr"], by_hand=MeasuredByHand(2000)).save(folder / "calibration.yaml")
    return folder


def commands_of(vehicles="12345", period_s=0.5, until_s=5.0):
    rows = [
        (COMMANDS_AHEAD_S + time, vehicle, 60, 40) for time in np.arange(0.0, until_s, period_s) for vehicle in vehicles
    ]
    return pd.DataFrame(rows, columns=["time_s", "vehicle", "left", "right"])


@pytest.fixture
def options(robots, drive, tmp_path):
    def with_changes(commands=None, **changes):
        (commands_of() if commands is None else commands).to_csv(tmp_path / "commands.csv", index=False)
        robot = robots["mgr"]
        chosen = {
            "robot": robot.model_dump() | {"marker": robot.marker.model_dump()},
            "video": str(drive / "pictures"),
            "calibration": str(drive / "calibration.yaml"),
            "camera_height_mm": None,
            "camera_above_mm": None,
            "commands": str(tmp_path / "commands.csv"),
            "video_began_s": COMMANDS_AHEAD_S,
            "longest_gap_s": 0.2,
            "run_s": 2.0,
            "format": "csv",
            "output": str(tmp_path / "recording"),
            "overwrite": False,
        }
        return track.Options.parse(chosen | changes, "swarmtwin track")

    return with_changes


def test_what_was_driven_is_recorded(options, robots, tmp_path, caplog):
    figures = track.run(options())
    recording = read_recording(tmp_path / "recording", robots["mgr"])
    assert figures["pictures"] == FRAMES
    assert recording.runs == ("run_001", "run_002", "run_003")
    assert recording.vehicles == tuple("12345")
    seen = 0
    for one in recording.tracks:
        index = int(one.vehicle) - 1
        for time_s, command, pose in zip(one.time_s, one.command, one.pose, strict=True):
            since_s = time_s - COMMANDS_AHEAD_S
            assert command.tolist() == [60, 40]
            hidden = one.vehicle == "4" and 2.0 <= since_s < 2.5
            assert np.isnan(pose).all() == hidden
            if not hidden:
                off = residual_between(poses_at(since_s)[index], pose)
                assert np.hypot(*off[:2]) < 0.3
                assert abs(off[2]) < np.deg2rad(0.3)
                seen += 1
    assert seen == 49
    poses = pd.read_parquet(tmp_path / "recording" / "poses.parquet")
    assert len(poses) == 5 * FRAMES - len(HIDDEN)
    assert not caplog.records


def test_prepare_takes_it(options, robots, tmp_path):
    kept = track.run(options())["transitions"]
    content = {
        "robot": robots["mgr"].model_dump(),
        "recording": str(tmp_path / "recording"),
        "split": {"fractions": {"train": 0.4, "validation": 0.3, "test": 0.3}, "seed": 1},
        "pictures": False,
        "output": str(tmp_path / "transitions"),
        "overwrite": False,
    }
    assert prepare.run(prepare.Options.parse(content, "swarmtwin prepare"))["transitions"] == kept > 25


def test_strangers_and_those_never_seen_are_named(options, caplog):
    track.run(options(commands_of("1239")))
    said = "\n".join(record.message for record in caplog.records)
    assert "vehicle 9 is never seen" in said
    assert f"marker 4 is seen on {FRAMES - len(HIDDEN)} pictures and belongs to no vehicle" in said
    assert f"marker 5 is seen on {FRAMES} pictures" in said


def test_a_marker_that_is_there_twice_is_not_believed_and_said(options, drive, tmp_path, caplog):
    folder = tmp_path / "twice"
    folder.mkdir()
    for number in range(24):
        picture = cv2.imread(str(drive / "pictures" / f"{number:04}.png"), cv2.IMREAD_GRAYSCALE)
        picture[300:350, 20:70] = another_marker_5()
        cv2.imwrite(str(folder / f"{number:04}.png"), picture)
    track.run(options(commands_of(until_s=0.8), video=str(folder)))
    said = "\n".join(record.message for record in caplog.records)
    assert "vehicle 5 is not believed on 24 pictures: marker 5 is there twice" in said


def another_marker_5():
    """Marker 5 as large as the vehicles' are seen, on white."""
    dictionary = cv2.aruco.getPredefinedDictionary(cv2.aruco.DICT_4X4_50)
    printed = cv2.aruco.generateImageMarker(dictionary, 5, 32)
    return cv2.copyMakeBorder(printed, 9, 9, 9, 9, cv2.BORDER_CONSTANT, value=230).clip(20, 230)


@pytest.mark.parametrize(
    ("change", "said"),
    [
        (lambda picture: cv2.rotate(picture, cv2.ROTATE_180), "upside down"),
        (lambda picture: cv2.flip(picture, 1), "mirrored"),
        (lambda picture: picture[:-20], "670 × 650, and the calibration is for 670 × 670"),
        (lambda picture: np.roll(picture, 40, axis=1), "the camera has moved"),
        (lambda picture: np.full_like(picture, 128), "none of the arena's"),
    ],
)
def test_pictures_that_do_not_fit_the_calibration_are_refused(options, drive, tmp_path, change, said):
    folder = tmp_path / "changed"
    folder.mkdir()
    picture = cv2.imread(str(drive / "pictures" / "0000.png"), cv2.IMREAD_GRAYSCALE)
    cv2.imwrite(str(folder / "0.png"), change(picture))
    with pytest.raises(UserError, match=said):
        track.run(options(video=str(folder)))
    assert not (tmp_path / "recording").exists()


@pytest.mark.parametrize(
    ("spoil", "said"),
    [
        (lambda table: table.drop(columns="left"), "commands.csv, row 1: column 'left' is missing"),
        (lambda table: table.assign(left=[*table.left[:-1], 400]), "row 51, column 'left': '400' is no left"),
        (lambda table: table.assign(time_s=COMMANDS_AHEAD_S), "vehicle '1' gets two commands at 100 s"),
        (lambda table: table[:0], "there are no commands"),
        (lambda table: table.assign(time_s=table.time_s + 900), "give video_began_s"),
        (lambda table: table[table.vehicle == "1"].assign(vehicle="40"), "none of the vehicles 40 is seen"),
        (lambda table: table[table.vehicle == "1"].assign(vehicle="47"), "marker 47, which lies on the arena's floor"),
    ],
)  # fmt: skip
def test_commands_that_make_no_sense_are_refused(options, tmp_path, spoil, said):
    with pytest.raises(UserError, match=said):
        track.run(options(spoil(commands_of())))
    assert not (tmp_path / "recording").exists()


def test_a_robot_without_a_marker_is_refused(options, robots):
    with pytest.raises(UserError, match="robot mgr has no marker"):
        track.run(options(robot=robots["mgr"].model_dump()))


def test_missing_inputs_are_found_out_at_once(drive, robots):
    content = {"robot": robots["mgr"].model_dump(), "video": str(drive), "calibration": None, "commands": "nowhere.csv"}
    with pytest.raises(UserError, match=r"commands nowhere.csv is missing: name a CSV file with time_s, vehicle, left"):
        check_inputs("track", content)
    with pytest.raises(UserError, match="there is nothing at video=nowhere"):
        check_inputs("track", content | {"commands": str(drive), "video": "nowhere"})
    with pytest.raises(UserError, match="no calibration nowhere"):
        check_inputs("track", content | {"commands": str(drive), "calibration": "nowhere"})
