"""`swarmtwin record film=...`: the film shows what the stand-ins did when, and the way back gives the recording."""

import cv2
import numpy as np
import pandas as pd
import pytest

from swarmtwin.commands.app import run_command
from swarmtwin.deploy.camera.opening import open_camera
from swarmtwin.recordings.reading import read_recording
from swarmtwin.standin.session import StandInSession, drive_session
from swarmtwin.studies.stand_in_film import write_film
from swarmtwin.studies.tracking.methods import corners_alone
from swarmtwin.studies.tracking.scenes import Case, Scenes

VEHICLES = ("1", "2")


@pytest.fixture(scope="module")
def filmed(robots, tmp_path_factory):
    """A session of 3 s, and the folder with its film."""
    folder = tmp_path_factory.mktemp("film")
    footage = drive_session(StandInSession(robots["mgr"], VEHICLES, 1, 6, seed=8))
    write_film(folder, footage, 10, 26)
    return footage, folder


def test_the_film_shows_the_true_poses_at_their_times(robots, filmed):
    footage, folder = filmed
    usual = {
        "camera_height_mm": 2000.0, "tilt_deg": 1.5, "turned_deg": 0.0, "k1": -0.03, "off_centre_px": (0.0, 0.0),
    }  # fmt: skip
    scenes = Scenes(robots["mgr"], VEHICLES, Case(title="usual", camera=usual), 1)
    look = corners_alone(scenes.true_calibration(), robots["mgr"], VEHICLES, cv2.aruco.CORNER_REFINE_SUBPIX)
    camera, frames = open_camera(str(folder / "video.mp4")), []
    while (frame := camera.next_frame(len(frames) - 1)) is not None:
        frames.append(frame)
    assert len(frames) == 31
    np.testing.assert_allclose([frame.captured_s for frame in frames], np.arange(31) / 10, atol=1e-3)
    assert (folder / "video.mp4").stat().st_size < 100_000
    for row in range(7):
        found = look(frames[5 * row].image)
        for index, vehicle in enumerate(VEHICLES):
            np.testing.assert_allclose(found[vehicle][:2], footage.state[:2, 0, row, index], atol=0.8)
    between = look(frames[7].image)["1"]
    start, end = footage.state[:2, 0, 1, 0], footage.state[:2, 0, 2, 0]
    np.testing.assert_allclose(between[:2], start + 0.4 * (end - start), atol=0.8)


def test_the_commands_are_those_that_were_sent(robots, filmed):
    footage, folder = filmed
    table = pd.read_csv(folder / "commands.csv", dtype={"vehicle": str})
    for index, vehicle in enumerate(VEHICLES):
        mine = table[table.vehicle == vehicle]
        np.testing.assert_allclose(mine.time_s, 0.5 * np.arange(6))
        np.testing.assert_allclose(mine[["left", "right"]], footage.command[0, :, index])


@pytest.mark.end_to_end
def test_recorded_filmed_calibrated_and_tracked_it_is_the_recording_again(workplace, robots):
    assert run_command("record", ["vehicle=[1,2]", "runs=1", "steps=8", "film=10", "seed=3", "output=clip"]) == 0
    of_clip = ["commands=clip/commands.csv", "video=clip/video.mp4", "output=tracked"]
    assert run_command("track", of_clip) == 0
    recorded, tracked = (read_recording(workplace / name, robots["mgr"]) for name in ("clip", "tracked"))
    for before, after in zip(recorded.tracks, tracked.tracks, strict=True):
        np.testing.assert_allclose(after.command[:8], before.command[:8])
        off_mm = np.hypot(*(after.pose[:8, :2] - before.pose[:8, :2]).T)
        assert np.nanmedian(off_mm) < 3.0  # the recording has its own noise of measurement


def test_a_film_of_several_runs_is_refused(workplace, capfd):
    assert run_command("record", ["runs=2", "steps=8", "film=10", "output=clip"]) == 2
    assert "film=... shows one run: say runs=1" in capfd.readouterr().err
