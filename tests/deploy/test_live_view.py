"""The live view: a process that shows what it is given, hears the red button, and can delay nobody."""

import json
import os
import signal
import time
import urllib.error
import urllib.request

import cv2
import numpy as np
import pytest
from playground import Playground, Told
from real_broker import wait_until

from swarmtwin.deploy.control.outcome import Watchmen
from swarmtwin.deploy.live_view.overlay import Overlay
from swarmtwin.deploy.live_view.slot import Slot
from swarmtwin.deploy.live_view.view_process import LiveView, Scene
from swarmtwin.deploy.tracking.sighting import Sighting
from swarmtwin.errors import UserError

CORNERS = ((60.0, 600.0), (600.0, 600.0), (600.0, 60.0), (60.0, 60.0))


def scene(**changes):
    content = {
        "title": "Micro-Ground Robot: collective",
        "vehicles": ("1", "2"),
        "colours": ("#3f74a8", "#d98e32"),
        "arena_mm": (0.0, 0.0, 1000.0, 1000.0),
        "vehicle_size_mm": (90.0, 84.0),
        "period_s": 0.5,
        "corners_px": CORNERS,
        "camera_px": (660, 660),
    }
    return Scene(**{**content, **changes})


def answer(view, path, data=None):
    with urllib.request.urlopen(view.address + path, data=data, timeout=5) as response:
        return response.read()


@pytest.fixture(scope="module")
def view():
    shown = LiveView(scene())
    yield shown
    shown.close()


def test_a_slot_gives_the_newest_whole_or_nothing(tmp_path):
    slot = Slot.create(tmp_path / "slot", 100)
    reader = Slot.open(tmp_path / "slot")
    assert reader.read() is None
    assert slot.write(b"one", b" two")
    number, content = reader.read()
    assert content == b"one two"
    assert reader.read(unless=number) is None
    assert not slot.write(bytes(101))
    assert reader.read() == (number, b"one two")
    slot._memory[:8] = (number + 1).to_bytes(8, "little")  # somebody writes
    assert reader.read() is None


def test_a_picture_is_brought_into_the_arenas_frame_whatever_way_the_camera_hangs():
    """A bright spot at a known place in the arena is found there in the overlay, also under a camera upside down."""
    arena = np.float32([[0, 0], [1000, 0], [1000, 1000], [0, 1000]])
    for corners in (CORNERS, CORNERS[2:] + CORNERS[:2]):
        to_px = cv2.getPerspectiveTransform(arena, np.float32(corners))
        [[spot]] = cv2.perspectiveTransform(np.float32([[[300, 800]]]), to_px)
        image = np.zeros((660, 660), np.uint8)
        cv2.circle(image, tuple(round(float(value)) for value in spot), 8, 255, -1)
        overlay = Overlay(scene(corners_px=corners))
        drawn = overlay.draw(image, {}, 0.0, {})
        y, x = (30 + np.mean(places) for places in np.nonzero(drawn[30:-30, 30:-30].min(axis=2) > 200))
        assert np.hypot(*(overlay._px(np.array([300.0, 800.0])) - (x, y))) < 2


def test_it_shows_poses_ages_and_alarms(view):
    now_s = time.monotonic()
    image = np.full((660, 660), 90, np.uint8)
    view.show_picture(image, Sighting(1, now_s, {"1": np.array([300.0, 400.0, 0.5])}))
    vehicle = {
        "pose": [500, 500, 0],
        "captured_s": now_s,
        "sent": [50.0, 60.0],
        "reason": "withheld: fence",
        "scale": 0,
    }
    view.publish(
        {"tick": 3, "vehicles": {"2": {**vehicle, "alarm": True}}, "targets_mm": [[500, 500]], "reach_mm": 250}
    )
    page = answer(view, "").decode()
    assert "Micro-Ground Robot: collective" in page
    picture = cv2.imdecode(np.frombuffer(answer(view, "picture.jpg"), np.uint8), cv2.IMREAD_COLOR)
    assert picture.shape[:2] == (760, 760)
    state = json.loads(answer(view, "state"))
    assert state["vehicles"]["2"]["alarm"]
    assert state["vehicles"]["2"]["reason"] == "withheld: fence"
    assert 0 <= state["vehicles"]["1"]["age_ms"] < 5000
    stream = urllib.request.urlopen(view.address + "picture", timeout=5)
    assert stream.readline() == b"--picture\r\n"
    assert stream.readline() == b"Content-Type: image/jpeg\r\n"
    stream.close()
    events = urllib.request.urlopen(view.address + "events", timeout=5)
    assert json.loads(events.readline().removeprefix(b"data: "))["tick"] == 3
    events.close()


def test_only_a_post_stops(view):
    view.heartbeat.write("stop_requested", 0)
    with pytest.raises(urllib.error.HTTPError):
        answer(view, "stop")
    assert not view.heartbeat.read("stop_requested")
    answer(view, "stop", b"")
    assert view.heartbeat.read("stop_requested")
    view.heartbeat.write("stop_requested", 0)


def test_a_port_that_is_taken_is_told(view):
    port = int(view.address.rstrip("/").rpartition(":")[2])
    with pytest.raises(UserError, match=f"the page cannot be served at 127.0.0.1:{port}: Address already in use"):
        LiveView(scene(port=port))


START = np.array([[300.0, 300.0, 0.0], [300.0, 700.0, 0.0]])


def watched_by(view):
    view.heartbeat.write("supervisor_beat_s", np.inf)
    return Watchmen(heartbeat=view.heartbeat, publish=view.publish)


def test_the_red_button_stops_the_vehicles(view, tmp_path):
    pressed = []

    def press():
        pressed.append(time.monotonic())
        answer(view, "stop", b"")

    with Playground(tmp_path, START, watchmen=watched_by(view)) as ground:
        outcome = ground.drive(Told(20 * np.ones((2, 2))), 60, then=press)
    view.heartbeat.write("stop_requested", 0)
    view.heartbeat.write("ask_supervisor", 0)
    assert (outcome.ending, outcome.reason) == ("stopped", "emergency stop on the page")
    assert outcome.is_standing
    assert ground.first_zeros_after(pressed[0]) < ground.robot.period_s + 0.05


def test_a_frozen_view_delays_nothing(view, tmp_path):
    """Lateness with a view that is stopped, against one that runs and is looked at."""
    late = {}
    image = np.zeros((660, 660), np.uint8)
    for frozen in (False, True):
        folder = tmp_path / str(frozen)
        folder.mkdir()
        with Playground(folder, START, watchmen=watched_by(view)) as ground:
            ground.observer._on_sighting = lambda sighting, frame: view.show_picture(image, sighting)
            if frozen:
                os.kill(view.pid, signal.SIGSTOP)
            try:
                outcome = ground.drive(Told(20 * np.ones((2, 2))), 25)
            finally:
                os.kill(view.pid, signal.SIGCONT)
        assert outcome.ending == "done"
        late[frozen] = np.median(outcome.lateness_s)
    assert late[True] < late[False] + 0.005
    assert wait_until(lambda: json.loads(answer(view, "state"))["tick"] == 24)
