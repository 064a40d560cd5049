"""What the tests of a deployment share: a real broker, links to it."""

import shutil

import pytest
from real_broker import Mosquitto

from swarmtwin.deploy.link.mqtt_link import connect


@pytest.fixture
def start_mosquitto(tmp_path):
    """Start a mosquitto with further lines of configuration."""
    if shutil.which("mosquitto") is None:
        pytest.skip("mosquitto is not installed")
    started = []

    def call(*options):
        started.append(Mosquitto(tmp_path, *options))
        return started[-1]

    yield call
    for one in started:
        one.thaw()
        one.stop()


@pytest.fixture
def mosquitto(start_mosquitto):
    """A mosquitto that lets anybody in."""
    return start_mosquitto()


@pytest.fixture
def link_to(robots):
    """Connect a link; it is closed at the end."""
    opened = []

    def call(broker, robot="mgr", name="test", **options):
        robot = robots[robot] if isinstance(robot, str) else robot
        opened.append(connect(robot, broker, name, **options))
        return opened[-1]

    yield call
    for link in opened:
        link.close()
