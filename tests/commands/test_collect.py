"""`swarmtwin collect` on a fleet behind a real broker: a new robot's first recording, safe without any model."""

import json
import shutil
import sys
from pathlib import Path

import numpy as np
import pandas as pd
import pytest
import yaml

from swarmtwin.commands.app import run_command
from swarmtwin.deploy.control.collecting import CollectingDriver
from swarmtwin.deploy.control.nominal_motion import nominal_simulation
from swarmtwin.deploy.fleet.fleet import Fleet, FleetSettings
from swarmtwin.recordings.reading import read_recording
from swarmtwin.transitions import from_recording
from tiny_policies import robot_named

sys.path.append(str(Path(__file__).parents[1] / "deploy"))
from real_broker import Mosquitto
from true_eyes import see_by

ROBOT = robot_named("mgr")


@pytest.fixture(scope="module")
def broker(tmp_path_factory):
    if shutil.which("mosquitto") is None:
        pytest.skip("mosquitto is not installed")
    one = Mosquitto(tmp_path_factory.mktemp("broker"))
    yield one
    one.stop()


@pytest.fixture
def collect(workplace, broker):
    """Collect with one vehicle of a fleet; return the exit status."""
    with Fleet(ROBOT, ("7",), broker.broker, 0, FleetSettings(camera={"mm_per_pixel": 6.0}, fps=1)) as fleet:
        see_by(fleet._memory)

        def call(*options):
            usual = ("vehicles=[7]", "page.show=false", "output=out", f"broker={broker.address}")
            return int(run_command("collect", [*usual, *options]))

        call.fleet = fleet
        yield call


@pytest.mark.end_to_end
def test_a_new_vehicle_is_recorded_by_nothing_but_its_robots_file(collect, capsys):
    collect.fleet.place({"7": (960.0, 500.0, 0.0)})  # it looks at the wall, near it
    assert collect("runs=2", "steps=8", "commands=held") == 0
    answer = capsys.readouterr()
    assert "runs" in answer.out
    recording = read_recording(Path("out"), ROBOT)
    assert recording.runs == ("run_001", "run_002")
    _, counts = from_recording(recording)
    assert counts.kept >= 14
    for track in recording.tracks:
        seen = track.pose[np.isfinite(track.pose[:, 0])]
        assert ((seen[:, :2] > -5) & (seen[:, :2] < 1035)).all()
        assert (track.command[-1] == 0).all()
    assert yaml.safe_load(Path("out/deployment.yaml").read_text())["outcome"]["runs"] == 2


def test_a_planned_drive_is_driven(collect, capsys):
    planned = np.array([[40.0, 30.0], [-40.0, 20.0], [20.0, 60.0], [0.0, 0.0]])
    collect.fleet.place({"7": (515.0, 515.0, 0.0)})
    folder = Path("diagnosis")
    folder.mkdir()
    pd.DataFrame(planned, columns=list(ROBOT.command_columns)).to_csv(folder / "next_drive.csv", index=False)
    assert collect("runs=1", "steps=10", "drive=diagnosis") == 0, capsys.readouterr().err
    [track] = read_recording(Path("out"), ROBOT).tracks
    assert track.command[:4] == pytest.approx(planned, abs=0.5)


@pytest.mark.parametrize(
    ("options", "message"),
    [
        (["vehicles=[7,7]"], "vehicle '7' is named twice: give each id once"),
        (["drive=nowhere.csv"], "drive nowhere.csv is missing: name a CSV file with left, right"),
        (["drive=empty"], "empty plans no next recording: its diagnosis has no causes that it could not tell apart"),
        (["simulation=nowhere"], "no model folder nowhere"),
        (["commands=wild"], "options: field 'commands': Input should be 'uniform', 'gentle' or 'held', got 'wild'"),
    ],
)
def test_a_mistake_is_one_line(workplace, capsys, options, message):
    Path("empty").mkdir()
    assert int(run_command("collect", ["output=out", *options])) == 2
    assert capsys.readouterr().err.strip().splitlines()[-1].startswith(f"swarmtwin collect: {message}")
    assert not Path("out").exists()


def test_commands_lead_back_from_the_border_and_away_from_each_other():
    simulation = nominal_simulation(ROBOT)
    rng = np.random.default_rng(1)
    driver = CollectingDriver(ROBOT, ROBOT.arena_mm, simulation, 2, "uniform", rng)
    pose = np.array([[1000.0, 500.0, 0.0], [970.0, 640.0, np.pi]])
    gained = []
    for _ in range(30):
        command = driver.decide(pose)
        turn, ahead = (command[:, 1] - command[:, 0]), command.sum(axis=1)
        gained.append([ahead[0] < 0 or abs(turn[0]) > abs(ahead[0]), ahead[1] > 0 or abs(turn[1]) > abs(ahead[1])])
    assert np.mean(gained) > 0.9
    assert driver.led_back == 60
    gentle = CollectingDriver(ROBOT, ROBOT.arena_mm, simulation, 1, "gentle", rng)
    wanted = np.array([gentle.decide(np.array([[515.0, 515.0, 0.0]])) for _ in range(200)])
    assert np.abs(wanted).max() <= 60
    assert json.dumps(float(np.abs(wanted).max())) > "55"
