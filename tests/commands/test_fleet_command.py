"""`swarmtwin fleet`: what it shows, and that nothing is left of it."""

import os
import re
import signal
import subprocess
import sys
import time
import urllib.request
from pathlib import Path

import pytest
import yaml

from swarmtwin.commands.app import config_folder, run_command
from swarmtwin.commands.fleet import Options
from swarmtwin.deploy.fleet.fleet import FleetSettings
from swarmtwin.robot import Robot
from swarmtwin.standin.overhead_camera import CameraConditions

SCRIPT = "import sys; from swarmtwin.commands import main; main()"
FREE = ("broker=embedded://127.0.0.1:0", "camera_port=0", "vehicles=2")


def options(**given):
    content = yaml.safe_load((config_folder() / "fleet.yaml").read_text())
    robot = Robot.load(config_folder() / "robot" / "mgr.yaml")
    content = {key: value for key, value in content.items() if key != "defaults"} | {"robot": robot} | given
    return Options.parse(content, "options")


def test_the_defaults_are_those_of_the_python_way():
    stated = options()
    camera = CameraConditions.parse(dict(stated.camera), "camera")
    assert camera == CameraConditions()
    assert stated.camera.keys() == CameraConditions.model_fields.keys()
    settings = {name: getattr(stated, name) for name in FleetSettings.model_fields if name != "camera"}
    assert FleetSettings(**settings) == FleetSettings()


@pytest.mark.parametrize(("given", "ids"), [(3, ("1", "2", "3")), ([2, 7], ("2", "7")), (["a"], ("a",))])
def test_vehicles_are_a_number_or_ids(given, ids):
    assert options(vehicles=given).vehicles == ids


def children_of(pid):
    """The processes that a process has started."""
    return [int(child) for child in Path(f"/proc/{pid}/task/{pid}/children").read_text().split()]


def is_gone(pid):
    try:
        os.kill(pid, 0)
    except ProcessLookupError:
        return True
    return False


@pytest.fixture
def running(tmp_path):
    """A fleet as a user starts it; its process and what it has shown until it was ready."""
    process = subprocess.Popen(
        [sys.executable, "-c", SCRIPT, "fleet", *FREE], cwd=tmp_path, stdout=subprocess.PIPE, stderr=subprocess.PIPE
    )
    shown = [process.stdout.readline().decode() for _ in range(4)]
    yield process, "".join(shown)
    process.kill()
    process.communicate()


@pytest.mark.skipif(not Path("/proc/self/task").exists(), reason="looks for processes in /proc")
@pytest.mark.parametrize("sign", [signal.SIGINT, signal.SIGKILL])
def test_it_says_where_it_is_and_ends_without_a_trace(running, sign):
    process, shown = running
    assert "2 × Micro-Ground Robot: 1, 2" in shown
    assert re.search(r"broker +mqtt://127.0.0.1:\d+   \(embedded, for a first try", shown)
    assert "a vehicle drives on when commands stop" in shown
    page = re.search(r"to look at: (\S+)", shown)[1]
    assert b"/camera" in urllib.request.urlopen(page, timeout=5).read()
    children = children_of(process.pid)
    assert len(children) == 4, "broker, camera, two robots"
    process.send_signal(sign)
    _, error = process.communicate(timeout=10)
    if sign == signal.SIGINT:
        assert process.returncode == 130
        assert error == b"swarmtwin fleet: interrupted; the emulated robots are switched off\n"
    end_s = time.monotonic() + 5
    while not all(is_gone(child) for child in children) and time.monotonic() < end_s:
        time.sleep(0.02)
    assert all(is_gone(child) for child in children)


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["robot=create"], "robot 'create' has no stand-in"),
        (["vehicles=0"], "vehicles"),
        (["camera.light=dark"], "camera: field 'light'"),
        (["effects=[{name: batery_sag}]"], "did you mean 'battery_sag'"),
        (["broker=127.0.0.1"], "broker=127.0.0.1 is no address of a broker"),
        (["broker=mqtt://127.0.0.1:1"], "no broker at mqtt://127.0.0.1:1"),
        (["broker.password_file=nowhere", "broker=mqtt://me@127.0.0.1"], "broker.password_file nowhere is missing"),
    ],
)
def test_a_mistake_is_one_message(workplace, capsys, arguments, message):
    assert run_command("fleet", [*FREE, *arguments]) == 2
    error = capsys.readouterr().err
    assert message in error
    assert error.count("\n") == 1
