"""`swarmtwin deploy` on a fleet behind a real broker: it drives, records, compares; every fault ends in standstill."""

import functools
import gc
import json
import multiprocessing
import os
import shutil
import signal
import sys
import threading
import time
import urllib.request
from pathlib import Path

import mlflow
import numpy as np
import pandas as pd
import pytest
import yaml

from swarmtwin.commands import deploy
from swarmtwin.commands.app import run_command
from swarmtwin.deploy.control import deployment as deployment_module
from swarmtwin.deploy.control.plan import Plan
from swarmtwin.deploy.fleet.fleet import Fleet, FleetSettings
from swarmtwin.deploy.fleet.orders import RobotFaults
from swarmtwin.deploy.link.mqtt_link import connect
from swarmtwin.files import CHECKPOINTS
from swarmtwin.recordings.reading import read_recording
from swarmtwin.tracking.registry import folder_digest
from tiny_policies import robot_named, save_seeker, simulation

sys.path.append(str(Path(__file__).parents[1] / "deploy"))
from real_broker import Mosquitto, wait_until
from true_eyes import see_by

ROBOT = robot_named("mgr")
STARTS = {"1": (250.0, 300.0, 0.7), "2": (780.0, 730.0, -2.5)}
STANDING_MM = 1.0


@pytest.fixture(scope="module")
def broker(tmp_path_factory):
    if shutil.which("mosquitto") is None:
        pytest.skip("mosquitto is not installed")
    one = Mosquitto(tmp_path_factory.mktemp("broker"))
    yield one
    one.thaw()
    one.stop()


@pytest.fixture(scope="module")
def running_fleet(broker):
    with Fleet(ROBOT, ("1", "2"), broker.broker, 0, FleetSettings(camera={"mm_per_pixel": 6.0}, fps=1), STARTS) as one:
        yield one


@pytest.fixture
def fleet(running_fleet):
    """Two vehicles in their places, standing, hearing."""
    running_fleet.set_faults(robots={})
    running_fleet.place(STARTS)
    return running_fleet


@pytest.fixture(scope="module", autouse=True)
def frozen_packages():
    """Let no deployment look through the million objects of all packages for what is left over: that takes a second."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(gc, "unfreeze", lambda: None)
        gc.freeze()
        yield
    gc.unfreeze()


class Stage:
    """A workplace with a policy for two vehicles, its simulation, and a fleet to deploy to."""

    def __init__(self, folder, fleet, broker, monkeypatch):
        self.folder, self.fleet, self.broker = folder, fleet, broker
        digest = folder_digest(simulation(folder / "kinematic", ROBOT))
        save_seeker(folder / "seeker", source="kinematic", digest=digest, hold_s=2.0, reach_mm=330.0)
        self.camera, self.tracker = see_by(fleet._memory)
        self.outcomes, self.deployments = [], []
        drive = deployment_module.Deployment.drive

        def kept(deployment, *arguments):
            self.deployments.append(deployment)
            self.outcomes.append(drive(deployment, *arguments))
            return self.outcomes[-1]

        monkeypatch.setattr(deployment_module.Deployment, "drive", kept)

    @property
    def options(self):
        usual = ("policy=seeker", "page.show=false", "compare=0", "target=[515,515]", "output=out", "steps=60")
        return (*usual, f"broker={self.broker.address}", "safety.standstill_wait_s=3")

    def deploy(self, *options, then=None, after_s=0.6):
        """Deploy; so long after the vehicles have begun to move, do something. Return the exit status."""
        at_s = []

        def act():
            if wait_until(self.moves, 20):
                time.sleep(after_s)
                at_s.append(time.monotonic())
                then(self)

        if then:
            threading.Thread(target=act, daemon=True).start()
        status = int(run_command("deploy", [*self.options, *options]))
        self.acted_s = at_s[0] if at_s else None
        return status

    def moves(self):
        return bool(np.abs(self.fleet._memory.velocities(time.monotonic())[:, :2]).max() > 5.0)  # mm/s

    def stands(self):
        before = self.fleet._memory.poses(time.monotonic())
        time.sleep(0.3)
        after = self.fleet._memory.poses(time.monotonic())
        return bool(np.abs(after - before)[:, :2].max() < STANDING_MM)


@pytest.fixture
def stage(workplace, fleet, broker, monkeypatch):
    monkeypatch.setenv("COLUMNS", "200")
    return Stage(workplace, fleet, broker, monkeypatch)


def test_it_drives_to_the_target_and_leaves_a_recording_figures_and_a_run(stage, capsys):
    status = stage.deploy("compare=20", "page.show=true", "page.port=0")
    answer = capsys.readouterr()
    assert status == 0, answer.err
    assert stage.stands()
    assert answer.err.count("nothing here can stop them") <= 1
    metrics = json.loads(Path("out/metrics.json").read_text())
    assert metrics["control"]["is_standing"]
    assert metrics["robots"]["success"]
    assert metrics["simulation"]["rollouts"] == 20
    assert "camera to command" in answer.out
    recording = read_recording(Path("out"), ROBOT)
    assert recording.vehicles == ("1", "2")
    track = recording.tracks[0]
    assert np.isfinite(track.pose[1:-1]).all()
    assert np.diff(track.time_s)[:-2] == pytest.approx(0.5, abs=0.1)
    sent = pd.read_parquet("out/sent.parquet")
    assert {"requested_left", "reason"} <= {*sent.columns}
    assert len(pd.read_parquet("out/poses.parquet")) > 20 * len(track)
    about = yaml.safe_load(Path("out/deployment.yaml").read_text())
    assert about["policy"]["source"] == "seeker"
    assert about["outcome"]["ending"] == "done"
    assert Path("out/paths.png").exists()
    assert not Path("out", CHECKPOINTS).exists()
    [run] = mlflow.search_runs(experiment_names=["swarmtwin/deployment"], output_format="list")
    assert run.data.metrics["robots_reward"] == pytest.approx(metrics["robots"]["reward"])
    assert run.data.tags["ending"] == "done"


@pytest.mark.end_to_end
def test_a_vehicle_drives_past_an_obstacle_that_it_was_told_of(stage, capsys):
    save_seeker(stage.folder / "passer", source="kinematic", task="obstacle", reach_mm=260.0)
    stage.fleet.place({"1": (250.0, 300.0, 0.7), "2": (200.0, 900.0, 0.0)})
    past = ("policy=passer", "vehicles=[1]", "target=[750,300]", "obstacles=[475,320,70]")
    status = stage.deploy(*past)
    assert status == 0, capsys.readouterr().err
    assert json.loads(Path("out/metrics.json").read_text())["robots"]["success"]
    poses = pd.read_parquet("out/poses.parquet").query("vehicle == '1'")
    assert poses.x_mm.iloc[-1] > 475 + 30
    assert np.hypot(poses.x_mm - 475, poses.y_mm - 320).min() > 70 + max(ROBOT.vehicle_size_mm) / 2
    assert yaml.safe_load(Path("out/deployment.yaml").read_text())["settings"]["obstacles"] == [[475.0, 320.0, 70.0]]


def foreign(stage):
    other = connect(ROBOT, stage.broker.broker, "other")
    other.send({"1": np.array([10.0, 10.0])})
    other.close()


def hide(stage):
    stage.tracker.hidden.add("2")


def unplug(stage):
    stage.camera.broken = True


def restart_broker(stage):
    stage.broker.stop()
    time.sleep(0.7)
    stage.broker.start()


def restart_broker_at_once(stage):
    stage.broker.stop()
    stage.broker.start()


def freeze_supervisor(stage):
    os.kill(stage.deployments[-1].supervisor.pid, signal.SIGSTOP)


def kill_supervisor(stage):
    os.kill(stage.deployments[-1].supervisor.pid, signal.SIGKILL)


def latch(stage):
    stage.deployments[-1].heartbeat.latch("the controller froze", time.monotonic())


def press(stage):
    urllib.request.urlopen(stage.deployments[-1].view.address + "stop", data=b"", timeout=5).close()


FAULTS = {
    "vehicle 2 has not been seen": (hide, False),
    "memory: unplugged|memory: no picture": (unplug, False),
    "somebody else commands the vehicles": (foreign, True),
    "broker|link": (restart_broker, True),
    "was lost for a moment|link": (restart_broker_at_once, True),
    "the supervisor has been silent": (freeze_supervisor, True),
    "the supervisor died": (kill_supervisor, True),
    "the supervisor has stopped the vehicles: the controller froze": (latch, True),
    "emergency stop on the page": (press, True),
}


@pytest.mark.parametrize("reason", FAULTS)
def test_each_fault_ends_in_standstill_a_recording_and_status_3(stage, capsys, reason):
    then, seen = FAULTS[reason]
    page = ("page.show=true", "page.port=0") if then is press else ()
    status = stage.deploy(*page, then=then)
    error = capsys.readouterr().err
    assert status == 3, error
    assert any(part in error for part in reason.split("|"))
    assert stage.stands()
    assert stage.outcomes[0].is_standing == seen
    assert ("all vehicles stand" if seen else "could not be seen to stand") in error
    if then not in (restart_broker, restart_broker_at_once):  # the robots take their time to come back
        assert stage.outcomes[0].stopped_s - stage.acted_s < ROBOT.period_s + 0.15
    assert len(read_recording(Path("out"), ROBOT).tracks) >= 2
    assert yaml.safe_load(Path("out/deployment.yaml").read_text())["outcome"]["ending"] == "stopped"


def test_a_robot_that_does_not_obey_is_named(stage, capsys):
    """It drives on while it is told to stand: it hears nothing any more."""
    stage.fleet.place({"1": (250.0, 300.0, 0.5), "2": (520.0, 530.0, -2.6)})

    def deafen(stage):
        stage.fleet.set_faults(robots={"1": RobotFaults(deaf=True)})

    status = stage.deploy("steps=40", then=deafen, after_s=0.3)
    error = capsys.readouterr().err
    stage.fleet.set_faults(robots={})
    stage.fleet.place(STARTS)  # somebody picks it up
    assert status == 3
    named = ("vehicle 1 does not obey", "vehicle 1 is", "vehicles 1 and 2", "not be seen to stand")
    assert any(part in error for part in named), error


@pytest.fixture
def in_a_process(stage):
    """Run `swarmtwin deploy` in a process forked from this one; what it says is left in the file `error`."""
    started = []

    def alone():
        with Path("error").open("w") as sys.stderr:
            sys.exit(int(run_command("deploy", stage.options)))

    def start():
        started.append(multiprocessing.get_context("fork").Process(target=alone))
        started[-1].start()
        return started[-1]

    yield start
    for one in started:
        one.kill()
        one.join()


def test_ctrl_c_stops_the_vehicles_and_ends_with_130(stage, in_a_process):
    process = in_a_process()
    assert wait_until(stage.moves, 30)
    time.sleep(0.7)
    os.kill(process.pid, signal.SIGINT)
    asked_s = time.monotonic()
    assert wait_until(lambda: not stage.moves(), 3)
    assert time.monotonic() - asked_s < ROBOT.period_s
    process.join(120)
    error = Path("error").read_text()
    assert process.exitcode == 130, error
    assert "all vehicles stand; the recording is in" in error
    assert len(read_recording(Path("out"), ROBOT).tracks) == 2


def test_a_controller_that_is_killed_loses_no_row_and_its_vehicles_stand(stage, in_a_process):
    process = in_a_process()
    assert wait_until(stage.moves, 30)
    time.sleep(1.2)
    process.kill()
    killed_s = time.monotonic()
    assert wait_until(lambda: not stage.moves(), 3)
    assert time.monotonic() - killed_s < ROBOT.period_s
    process.join()
    assert wait_until(Path("out/recording.yaml").exists, 20)  # by the supervisor
    assert stage.stands()
    tracks = read_recording(Path("out"), ROBOT).tracks
    journal = Path("out/journal.jsonl").read_text().splitlines()
    periods = [json.loads(line) for line in journal if line.startswith('{"kind":"period"')]
    assert all(len(track) >= len(periods) for track in tracks)
    assert (tracks[0].command[-1] == 0).all()
    outcome = yaml.safe_load(Path("out/deployment.yaml").read_text())["outcome"]
    assert outcome == {"ending": "stopped", "reason": "the controller died"}


def test_a_controller_that_freezes_is_stopped_by_the_supervisor_and_never_drives_again(stage, in_a_process):
    process = in_a_process()
    assert wait_until(stage.moves, 30)
    time.sleep(0.7)
    os.kill(process.pid, signal.SIGSTOP)
    frozen_s = time.monotonic()
    assert wait_until(lambda: not stage.moves(), 3)
    assert time.monotonic() - frozen_s < ROBOT.period_s
    time.sleep(1.0)
    os.kill(process.pid, signal.SIGCONT)
    moved = False
    until_s = time.monotonic() + 1.0
    while time.monotonic() < until_s:
        moved |= stage.moves()
        time.sleep(0.005)
    process.join(120)
    error = Path("error").read_text()
    assert not moved
    assert process.exitcode == 3, error
    assert "the supervisor has stopped the vehicles: the controller froze" in error


@pytest.mark.parametrize(
    ("options", "message"),
    [
        (["robot=mur"], "seeker is a policy of robot 'mgr': add robot=mgr"),
        (["task=pair"], "seeker is a policy for task 'collective', not for 'pair': name another"),
        (["vehicles=[1,2,3]"], "vehicles=[1,2,3] are 3, the policy is for 2: give as many ids"),
        (["target=[5000,0]"], "target=((5000.0, 0.0),) is not within the arena, [0.0, 0.0] to [1030.0, 1030.0] mm"),
        (["obstacles=[1,2,3]"], "task 'collective' has 0 obstacles, 1 are told: leave obstacles= out"),
        (["broker=mqtt://127.0.0.1:1"], "no broker at mqtt://127.0.0.1:1"),
        (["vehicles=[1,9]"], "vehicle 9 not seen: put it under the camera"),
        (["safety.scales=[1,0.5]"], "options: field 'safety.scales': Value error, scales must fall from 1 to 0"),
        (["policy=models:/mgr-policy@champion"], "no registered model 'mgr-policy'"),
        (["recover=nothing"], "there is nothing to recover for"),
    ],
)
def test_a_mistake_is_one_line_before_anything_moves(stage, capsys, monkeypatch, options, message):
    monkeypatch.setattr(deploy, "Plan", functools.partial(Plan, wait_s=0.5))
    status = stage.deploy(*options)
    error = capsys.readouterr().err.strip().splitlines()
    assert status == 2, error
    assert error[-1].startswith(f"swarmtwin deploy: {message}")
    assert not stage.moves()
    assert not Path("out").exists()


def test_vehicles_that_stand_too_near_are_refused_before_anything_moves(stage, capsys):
    stage.fleet.place({"1": (400.0, 500.0, 0.0), "2": (560.0, 500.0, 0.0)})
    assert stage.deploy("safety.too_near_mm=200") == 2
    assert "vehicles 1 and 2 are too near each other, 160 mm: put the vehicles apart" in capsys.readouterr().err
    assert not stage.moves()


def test_where_a_deployment_was_killed_nothing_is_overwritten(stage, capsys):
    left = Path(f".out.partial/{CHECKPOINTS}")
    left.mkdir(parents=True)
    (left / "journal.jsonl").write_text("")
    assert stage.deploy("overwrite=true") == 2
    assert "was killed, and its recording is not finished: swarmtwin deploy recover=out" in capsys.readouterr().err
    assert (left / "journal.jsonl").exists()


def test_the_shipped_settings_are_the_defaults():
    from swarmtwin.configuration import config_folder
    from swarmtwin.deploy.control.settings import SafetySettings, TimingSettings, WatchSettings

    conf = config_folder()
    assert SafetySettings(**yaml.safe_load((conf / "safety/default.yaml").read_text())) == SafetySettings()
    assert WatchSettings(**yaml.safe_load((conf / "watch/default.yaml").read_text())) == WatchSettings()
    for name in ("deploy", "collect"):
        assert TimingSettings(**yaml.safe_load((conf / f"{name}.yaml").read_text())["timing"]) == TimingSettings()
    assert deploy.Options.model_fields["safety"].annotation is SafetySettings
