"""Several recordings as one: every run once, by a name of its own, and nothing put together that does not belong so."""

import dataclasses
from pathlib import Path

import numpy as np
import pytest

from swarmtwin.errors import UserError
from swarmtwin.recordings.joining import joined
from swarmtwin.recordings.recording import Header, Recording, Track
from swarmtwin.recordings.writing import write_recording
from swarmtwin.transitions.inputs import read_several


@pytest.fixture
def recorded(robots):
    """A recording of two runs of a vehicle."""

    def of(vehicle, **about):
        robot = robots["mgr"]
        header = {"robot": "mgr", "period_s": robot.period_s, "arena_mm": robot.arena_mm, "source": "a test"} | about
        time_s = np.arange(4) * robot.period_s
        command, pose = np.full((4, 2), 20.0), np.full((4, 3), 500.0) + np.arange(4)[:, None] * [1.0, 0.0, 0.0]
        pose[:, 2] = 0.1
        tracks = tuple(Track(f"run_{number}", vehicle, time_s, command, pose) for number in (1, 2))
        return Recording(robot, Header(**header), tracks, {"no_pose": 1}, f"digest of {vehicle}")

    return of


def test_runs_are_called_by_their_recording_and_nothing_of_them_changes(recorded):
    both = joined({Path("lab/clean-1"): recorded("1"), Path("lab/clean-2"): recorded("2")})
    assert both.runs == ("clean-1_run_1", "clean-1_run_2", "clean-2_run_1", "clean-2_run_2")
    assert both.vehicles == ("1", "2")
    assert both.dropped_rows == {"no_pose": 2}
    assert [track.digest() for track in both.tracks[:2]] == [track.digest() for track in recorded("1").tracks]
    assert both.digest not in {recorded("1").digest, recorded("2").digest, ""}


def test_who_gives_two_vehicles_one_id_is_told(recorded):
    apart = joined({Path("clean-1"): recorded("1"), Path("clean-2"): recorded("2")})
    assert not apart.warnings
    again = dataclasses.replace(recorded("1"), digest="another digest")
    (warning,) = joined(
        {Path("clean-1"): recorded("1"), Path("monday"): again, Path("clean-2"): recorded("2")}
    ).warnings
    assert "vehicle '1' of clean-1 and monday is taken for one and the same" in warning


def test_one_recording_stays_as_it_is_and_folders_of_one_name_are_told_apart(recorded):
    alone = recorded("1")
    assert joined({Path("clean"): alone}) is alone
    folders = Path("monday/clean"), Path("friday/clean"), Path("2_clean")
    runs = joined({folder: recorded(vehicle) for folder, vehicle in zip(folders, "123", strict=True)}).runs
    assert runs == tuple(f"{name}_run_{number}" for name in ("1_clean", "2_clean", "3_2_clean") for number in (1, 2))


def test_a_recording_that_is_given_twice_is_refused(recorded):
    with pytest.raises(UserError, match="again and clean are the same recording: give it once"):
        joined({Path("clean"): recorded("1"), Path("again"): recorded("1")})


def test_recordings_of_other_arenas_or_periods_are_refused(recorded, robots):
    wider = robots["mgr"].arena_mm.model_copy(update={"x": (0.0, 2000.0)})
    for about, what in (({"arena_mm": wider}, "arena_mm"), ({"period_s": 0.4}, "period_s 0.4")):
        with pytest.raises(UserError, match=f"away is a recording with {what}.* and clean one with"):
            joined({Path("clean"): recorded("1"), Path("away"): recorded("2", **about)})


def test_of_several_recordings_the_vehicles_asked_for_are_read(recorded, robots, tmp_path):
    folders = [tmp_path / f"clean-{vehicle}" for vehicle in (1, 2, 3)]
    for folder, vehicle in zip(folders, "123", strict=True):
        folder.mkdir()
        recording = recorded(vehicle)
        write_recording(folder, recording.robot, recording.header, recording.tracks)
    parts = read_several(folders, robots["mgr"], ("1", "3"))
    assert [len(part.tracks) for part in parts.values()] == [2, 0, 2]
    with pytest.raises(UserError, match=r"clean-1, .*clean-3: no vehicle '4'"):
        read_several(folders, robots["mgr"], ("4",))
