"""The control loop over vehicles in memory: it drives, and every line of safety stops them within a period."""

import time

import numpy as np
import pytest
from playground import Playground, Told

from swarmtwin.deploy.control.driver import PolicyDriver
from swarmtwin.deploy.control.journal import read_journal
from tiny_policies import task_named

APART = np.array([[300.0, 300.0, 0.0], [300.0, 700.0, 0.0], [700.0, 500.0, 3.0]])


def test_it_drives_and_ends_with_vehicles_that_stand(tmp_path):
    with Playground(tmp_path, APART) as ground:
        outcome = ground.drive(Told([[60, 60], [40, 60], [0, 0]]), periods=8)
    assert (outcome.ending, outcome.reason, outcome.is_standing) == ("done", "8 periods are over", True)
    moved = ground.vehicles.poses() - APART
    assert 8 * 0.35 * 60 * 0.85 < moved[0, 0] < 8 * 0.35 * 60 * 1.15
    assert abs(moved[2]).max() < 1e-9
    lines = list(read_journal(ground.journal.path))
    assert [line["tick"] for line in lines if line["kind"] == "period"] == list(range(8))
    assert lines[-1]["kind"] == "end"
    assert lines[-1]["is_standing"]
    assert outcome.camera_to_command_s
    assert np.median(outcome.camera_to_command_s) < 0.06


FAULTS = {
    "not been seen": lambda ground: ground.tracker.hidden.add("2"),
    "unplugged|no picture": lambda ground: setattr(ground.camera, "broken", True),
    "link|no connection": lambda ground: setattr(ground.vehicles, "lost", True),
    "lost for a moment": lambda ground: setattr(ground.vehicles, "interruptions", 1),
    "interrupted by SIGINT": lambda ground: setattr(ground.controller.watchmen.interrupts, "signalled", "SIGINT"),
    "emergency stop by key": lambda ground: setattr(ground.controller.watchmen.interrupts, "key", True),
}


@pytest.mark.parametrize("reason", FAULTS)
def test_each_fault_stops_all_vehicles(tmp_path, reason):
    happened = []

    def fault():
        happened.append(time.monotonic())
        FAULTS[reason](ground)
        if reason.startswith("link"):  # it comes back, and the zeros go through
            time.sleep(0.4)
            ground.vehicles.lost = False
            happened.append(time.monotonic())

    with Playground(tmp_path, APART, pose_age_s=0.3, picture_age_s=0.2) as ground:
        outcome = ground.drive(Told(20 * np.ones((3, 2))), periods=40, then=fault)
        stands = abs(ground.vehicles.poses() - ground.vehicles.poses()).max() < 1e-9
    assert outcome.ending == ("interrupted" if "SIGINT" in reason else "stopped")
    assert any(part in outcome.reason for part in reason.split("|"))
    assert stands
    assert outcome.is_standing == (reason not in ("not been seen", "unplugged|no picture"))
    allowed_s = {"not been seen": 0.3, "unplugged|no picture": 0.2}.get(reason, 0.0)
    assert ground.first_zeros_after(happened[-1]) < allowed_s + ground.robot.period_s + 0.03


class Onlooker:
    """A policy that wants to go on straight, and keeps what it is shown."""

    def __init__(self):
        self.shown = []

    def act(self, observation):
        self.shown.append(observation[0])
        return np.full((1, observation.shape[1], 2), 110.0 - 10 * len(self.shown))


def test_a_policy_sees_the_commands_that_were_really_sent(tmp_path):
    task = task_named("collective", vehicles=3, sees_commands=2, separation_mm=200)
    with Playground(tmp_path, np.array([[930.0, 300.0, 0.0], [300.0, 700.0, 0.0], [700.0, 500.0, 3.0]])) as ground:
        task = task.build(ground.robot)
        policy = Onlooker()
        ground.drive(PolicyDriver(policy, task, np.array([[515.0, 515.0]])), periods=6)
    periods = [line for line in read_journal(ground.journal.path) if line["kind"] == "period"]
    sent = [np.array(line["sent"]) for line in periods]
    requested = [np.array(line["requested"]) for line in periods]
    assert any((asked != given).any() for asked, given in zip(requested, sent, strict=True))  # the filter intervenes
    told = [np.zeros((3, 2))] * 2 + sent
    assert len(periods) == len(policy.shown) == 6
    for tick, shown in enumerate(policy.shown):
        expected = np.concatenate([told[tick + 1], told[tick]], axis=-1) / 120
        assert shown[:, -4:] == pytest.approx(expected, abs=1e-6)
