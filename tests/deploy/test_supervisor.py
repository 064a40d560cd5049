"""The supervisor as a process of its own on a real broker: the controller freezes, dies, wakes; zeros come in time."""

import json
import os
import signal
import subprocess
import sys
import time

import numpy as np
import pytest
from real_broker import wait_until

from swarmtwin.deploy.control.heartbeat import Heartbeat, LatchReason, Phase
from swarmtwin.deploy.control.supervisor import Orders, SupervisorProcess
from tiny_policies import robot_named

SILENCE_S = 0.25
"""Half the period of the MGR."""


class Ear:
    """Hears all commands, as a vehicle does: (when, {vehicle: command})."""

    def __init__(self, link_to, broker):
        self.heard = []
        link = link_to(broker)
        listened = link._on_message

        def listen(client, userdata, message):
            if message.topic == link.robot.link.command_topic:
                self.heard.append((time.monotonic(), json.loads(message.payload)))
            listened(client, userdata, message)

        link._client.on_message = listen

    def zeros_after(self, moment_s):
        at_rest = {"1": {"L": 0, "R": 0}, "2": {"L": 0, "R": 0}}
        return [heard_s - moment_s for heard_s, said in self.heard if said == at_rest and heard_s >= moment_s]


def orders(folder, address, recover=None):
    robot = robot_named("mgr")
    return Orders(
        heartbeat=folder / "heartbeat",
        vehicles=("1", "2"),
        silence_s=SILENCE_S,
        zeros_every_s=0.05,
        stops_for_s=0.5,
        log=folder / "supervisor.jsonl",
        recover=recover,
        link={
            "factory": "swarmtwin.deploy.control.supervisor:mqtt_link",
            "robot": robot.model_dump(mode="json") | {"link": robot.link.model_dump(mode="json")},
            "broker": {"address": address, "password_file": None, "ca_file": None},
        },
    )


@pytest.fixture
def supervised(tmp_path, mosquitto, link_to):
    """A supervisor that watches this process; heartbeat, ear, process."""
    heartbeat = Heartbeat.create(tmp_path / "heartbeat")
    ear = Ear(link_to, mosquitto.broker)
    process = SupervisorProcess(orders(tmp_path, mosquitto.address))
    assert process.wait_until_ready(heartbeat) is None
    yield heartbeat, ear, process
    heartbeat.phase = Phase.ENDED
    if process.is_alive():
        os.kill(process.pid, signal.SIGCONT)
    process.close()


def beat_for(heartbeat, seconds):
    until_s = time.monotonic() + seconds
    while time.monotonic() < until_s:
        heartbeat.write("controller_beat_s", time.monotonic())
        time.sleep(0.01)
    return time.monotonic()


def test_a_controller_that_lives_is_left_alone_and_one_that_freezes_is_stopped_in_half_a_period(supervised):
    heartbeat, ear, _ = supervised
    heartbeat.write("controller_beat_s", time.monotonic())
    heartbeat.phase = Phase.DRIVING
    last_s = beat_for(heartbeat, 0.6)
    assert heartbeat.latched is None
    assert not ear.heard
    assert wait_until(lambda: len(ear.zeros_after(last_s)) > 4)
    zeros_s = ear.zeros_after(last_s)
    assert SILENCE_S - 0.02 < zeros_s[0] < 0.5
    assert np.diff(zeros_s).max() < 0.15
    assert heartbeat.latched == LatchReason.FROZE
    beat_for(heartbeat, 0.2)  # it wakes: that changes nothing any more
    assert heartbeat.latched == LatchReason.FROZE


def test_before_and_after_driving_silence_is_no_matter(supervised):
    heartbeat, ear, _ = supervised
    for phase in (Phase.PREPARING, Phase.STOPPING, Phase.ENDED):
        heartbeat.phase = phase
        time.sleep(1.5 * SILENCE_S)
    assert heartbeat.latched is None
    assert not ear.heard


def test_a_controller_that_asks_is_helped(supervised):
    heartbeat, ear, _ = supervised
    beat_for(heartbeat, 0.05)
    heartbeat.phase = Phase.STOPPING
    asked_s = time.monotonic()
    heartbeat.write("ask_supervisor", 1)
    assert wait_until(lambda: ear.zeros_after(asked_s))
    assert ear.zeros_after(asked_s)[0] < 0.1
    assert heartbeat.latched == LatchReason.ASKED


def test_it_shows_that_it_lives_and_when_it_is_frozen_it_does_not(supervised):
    heartbeat, _, process = supervised
    time.sleep(0.1)
    assert time.monotonic() - heartbeat.read("supervisor_beat_s") < 0.1
    assert heartbeat.read("supervisor_connected") == 1
    os.kill(process.pid, signal.SIGSTOP)
    time.sleep(0.3)
    assert time.monotonic() - heartbeat.read("supervisor_beat_s") > 0.25


CONTROLLER = """
import sys, time
from pathlib import Path
from swarmtwin.deploy.control.heartbeat import Heartbeat, Phase
from swarmtwin.deploy.control.supervisor import Orders, SupervisorProcess
orders = Orders.model_validate_json(sys.argv[1])
heartbeat = Heartbeat.open(orders.heartbeat)
process = SupervisorProcess(orders)
assert process.wait_until_ready(heartbeat) is None
heartbeat.write("controller_beat_s", time.monotonic())
heartbeat.phase = Phase.DRIVING
print(process.pid, flush=True)
while True:
    heartbeat.write("controller_beat_s", time.monotonic())
    time.sleep(0.01)
"""


def test_a_controller_that_is_killed_is_followed_by_zeros_at_once_and_the_supervisor_ends(tmp_path, mosquitto, link_to):
    heartbeat = Heartbeat.create(tmp_path / "heartbeat")
    ear = Ear(link_to, mosquitto.broker)
    told = orders(tmp_path, mosquitto.address).model_dump_json()
    controller = subprocess.Popen([sys.executable, "-c", CONTROLLER, told], stdout=subprocess.PIPE)
    pid = int(controller.stdout.readline())
    time.sleep(0.2)
    assert not ear.heard
    killed_s = time.monotonic()
    controller.kill()
    controller.wait()
    controller.stdout.close()
    assert wait_until(lambda: ear.zeros_after(killed_s))
    assert ear.zeros_after(killed_s)[0] < 0.1
    assert wait_until(lambda: not _lives(pid))
    assert heartbeat.latched == LatchReason.DIED
    assert len(ear.zeros_after(killed_s)) >= 8


def _lives(pid):
    try:
        with open(f"/proc/{pid}/stat") as file:  # noqa: PTH123
            return file.read().rpartition(")")[2].split()[0] != "Z"
    except FileNotFoundError:
        return False


def test_it_needs_no_torch_to_start():
    script = (
        "import swarmtwin.deploy.control.supervisor, sys; print(sorted({'torch', 'scipy', 'cv2'} & {*sys.modules}))"
    )
    answer = subprocess.run([sys.executable, "-c", script], capture_output=True, text=True, check=True)
    assert answer.stdout.strip() == "[]"


def test_a_broker_that_is_not_there_is_told(tmp_path):
    heartbeat = Heartbeat.create(tmp_path / "heartbeat")
    process = SupervisorProcess(orders(tmp_path, "mqtt://127.0.0.1:1"))
    problem = process.wait_until_ready(heartbeat)
    process.close()
    assert "no broker at mqtt://127.0.0.1:1" in problem
