"""What a hop through a broker takes, and what a fleet costs: figures, never an assertion about time."""

import os
import shutil
import subprocess
import time
import urllib.request
from threading import Thread

import numpy as np
import pytest

from swarmtwin.deploy.fleet.fleet import Fleet
from swarmtwin.deploy.link.broker import Broker
from swarmtwin.deploy.link.embedded_broker import EmbeddedBroker
from swarmtwin.deploy.link.mqtt_link import connect

pytestmark = pytest.mark.benchmark_figures


@pytest.fixture
def mosquitto(tmp_path):
    if shutil.which("mosquitto") is None:
        pytest.skip("mosquitto is not installed")
    (tmp_path / "mosquitto.conf").write_text("listener 18831 127.0.0.1\nallow_anonymous true\n")
    process = subprocess.Popen(["mosquitto", "-c", tmp_path / "mosquitto.conf"], stderr=subprocess.DEVNULL)
    time.sleep(0.5)
    yield Broker(host="127.0.0.1", port=18831)
    process.kill()
    process.wait()


def hop_ms(robot, broker, messages=1000):
    """Times (messages,) in ms from sending to reading one's own message."""
    link = connect(robot, broker, "benchmark")
    times = []
    for number in range(messages):
        sent_s = link.send({"1": np.array([number % 100, 0])})
        while link.unanswered_s and time.monotonic() - sent_s < 1:
            time.sleep(0.0001)
        times.append(1000 * (time.monotonic() - sent_s))
    link.close()
    return np.array(times)


def test_a_hop(robots, mosquitto):
    with EmbeddedBroker(port=0) as embedded:
        for name, broker in (("mosquitto", mosquitto), ("embedded", embedded.broker)):
            hop = hop_ms(robots["mgr"], broker)
            print(
                f"\n{name}: a hop takes {np.median(hop):.2f} ms (median), {np.percentile(hop, 99):.2f} ms (p99)", end=""
            )


def busy_s(pid):
    with open(f"/proc/{pid}/stat") as stat:  # noqa: PTH123
        fields = stat.read().rsplit(")", 1)[1].split()
    return (int(fields[11]) + int(fields[12])) / os.sysconf("SC_CLK_TCK")


@pytest.mark.parametrize("count", [5, 20])
def test_a_fleet(robots, mosquitto, count):
    robot, vehicles = robots["mgr"], [str(number + 1) for number in range(count)]
    rng, ages_ms, for_s = np.random.default_rng(1), [], 20
    with Fleet(robot, vehicles, mosquitto, camera_port=0) as fleet:
        link = connect(robot, mosquitto, "benchmark")
        Thread(target=watch, args=(fleet.camera_url, ages_ms), daemon=True).start()
        pids = [*(process.pid for process in fleet.robots.values()), fleet.camera.pid]
        time.sleep(1)
        began_s, before_s, shown = time.monotonic(), [busy_s(pid) for pid in pids], len(ages_ms)
        while time.monotonic() - began_s < for_s:
            link.send({vehicle: rng.uniform(robot.command_low, robot.command_high) for vehicle in vehicles})
            time.sleep(robot.period_s)
        passed_s = time.monotonic() - began_s
        shares = (np.array([busy_s(pid) for pid in pids]) - before_s) / passed_s
        ages = np.array(ages_ms[shown:])
        link.close()
        print(
            f"\n{count} vehicles: {100 * shares[:-1].mean():.1f} % of a core each ({100 * shares[:-1].max():.1f} % at "
            f"most), camera {100 * shares[-1]:.0f} %; {len(ages) / passed_s:.1f} pictures/s, "
            f"{np.median(ages):.0f} ms old (median), {np.percentile(ages, 99):.0f} ms (p99) when they arrive; "
            f"load of the machine {os.getloadavg()[0]:.1f}; {fleet.status()}",
            end="",
        )


def watch(url, ages_ms):
    stream = urllib.request.urlopen(url)
    while line := stream.readline():
        name, _, value = line.decode().partition(": ")
        if name == "Content-Length":
            length = int(value)
        if name == "X-Timestamp":
            stream.readline()
            stream.read(length)
            ages_ms.append(1000 * (time.time() - float(value)))
