"""A fleet on a real broker: what it is told, it does, and what is done to it, it shows; seen as a host sees it."""

import json
import os
import signal
import threading
import time
import urllib.error
import urllib.request

import cv2
import numpy as np
import pytest
from real_broker import free_port, wait_until

from swarmtwin.deploy.fleet.fleet import Fleet, FleetSettings
from swarmtwin.deploy.fleet.orders import CameraFaults
from swarmtwin.deploy.link.broker import Broker
from swarmtwin.errors import UserError
from swarmtwin.geometry import displacement_between
from swarmtwin.standin.live import LiveVehicles
from swarmtwin.standin.overhead_camera import CameraConditions, OverheadCamera

STARTS = {"1": (300.0, 300.0, 0.4), "2": (700.0, 350.0, 2.0), "3": (500.0, 750.0, -1.5)}
STRAIGHT = np.array([80.0, 80.0])
REST = np.zeros(2)


class Viewer:
    """Reads MJPEG as the simplest of clients does: (arrival, stamp, picture), on the clock of the wall."""

    def __init__(self, url):
        self.pictures = []
        self._stream = urllib.request.urlopen(url, timeout=10)
        assert self._stream.headers["Content-Type"].startswith("multipart/x-mixed-replace; boundary=")
        threading.Thread(target=self._read, daemon=True).start()

    def _read(self):
        try:
            while headers := self._headers():
                jpeg = self._stream.read(int(headers["Content-Length"]))
                self.pictures.append((time.time(), float(headers["X-Timestamp"]), jpeg))
        except (OSError, ValueError):
            return

    def _headers(self):
        headers = {}
        while line := self._stream.readline():
            name, _, value = line.decode().strip().partition(": ")
            headers[name] = value
            if not name and "X-Timestamp" in headers:
                return headers
        return None

    def next(self, after_s=None):
        """The next picture that was taken from now on."""
        after_s = time.time() if after_s is None else after_s
        assert wait_until(lambda: self.pictures and self.pictures[-1][1] > after_s)
        arrived_s, stamp_s, jpeg = self.pictures[-1]
        return arrived_s, stamp_s, cv2.imdecode(np.frombuffer(jpeg, np.uint8), cv2.IMREAD_GRAYSCALE)


class Watch:
    """Where the vehicles of a fleet are, all the time: when a picture arrives, another motion may be under way."""

    def __init__(self, fleet):
        self._fleet, self._seen, self._over = fleet, [], threading.Event()
        self._thread = threading.Thread(target=self._look)

    def __enter__(self):
        self._thread.start()
        return self

    def __exit__(self, *_):
        self._over.set()
        self._thread.join()

    def _look(self):
        while not self._over.wait(0.005):
            now_s = time.monotonic()
            poses = np.array([*self._fleet.true_poses(now_s).values()])
            if time.monotonic() - now_s < 0.002:
                self._seen.append((now_s, poses))

    def poses(self, time_s):
        """The poses (V, 3) at a monotonic time, of vehicles whose headings do not jump."""
        assert wait_until(lambda: self._seen[-1][0] > time_s)
        times_s, poses = (np.array(some) for some in zip(*self._seen, strict=True))
        later = np.searchsorted(times_s, time_s)
        share = (time_s - times_s[later - 1]) / (times_s[later] - times_s[later - 1])
        return poses[later - 1] + share * (poses[later] - poses[later - 1])


def markers(picture):
    """The markers in a picture: corners (4, 2) by id."""
    dictionary = cv2.aruco.getPredefinedDictionary(cv2.aruco.DICT_4X4_50)
    corners, ids, _ = cv2.aruco.ArucoDetector(dictionary).detectMarkers(picture)
    return {int(number): one[0] for number, one in zip(np.ravel(ids), corners, strict=True)} if len(corners) else {}


def post(url, content):
    request = urllib.request.Request(url, json.dumps(content).encode(), method="POST")
    with urllib.request.urlopen(request, timeout=10) as answer:
        return json.loads(answer.read())


@pytest.fixture
def start_fleet(robots, mosquitto):
    started = []

    def call(vehicles="123", start=STARTS, **settings):
        start = {vehicle: start[vehicle] for vehicle in vehicles} if start else None
        fleet = Fleet(robots["mgr"], tuple(vehicles), mosquitto.broker, 0, FleetSettings(**settings), start)
        started.append(fleet)
        return fleet

    yield call
    for one in started:
        one.close()


def drive(link, fleet, command, vehicles="123"):
    """Send a command and wait until the vehicles have it."""
    link.send(dict.fromkeys(vehicles, command))
    assert wait_until(lambda: all((fleet.true_commands()[one] == command).all() for one in vehicles))


def stands(fleet, vehicle, for_s=0.15):
    """Whether a vehicle moves by less than a fifth of a millimetre a second."""
    before = fleet.true_poses()[vehicle]
    time.sleep(for_s)
    return np.abs(fleet.true_poses()[vehicle] - before).max() < 0.2 * for_s


def driven_in_time(fleet, link, period_s, commands):
    """True poses (T + 1, V, 3) around commands (T, V, 2), each of which was in force for its period but for a moment.

    Where the machine kept one from it, the vehicles begin anew, whatever they did.
    """
    for _ in range(30):
        fleet.place(STARTS)
        frozen_s = fleet._memory.skipped_s()
        poses, late_s, due_s = [], [], time.monotonic()
        for command in [*commands, np.tile(REST, (len(commands[0]), 1))]:
            time.sleep(max(0, due_s - time.monotonic()))
            sent_s = link.send(dict(zip("123", command, strict=True)))
            poses.append([*fleet.true_poses(sent_s).values()])
            told = wait_until(lambda told=command: np.array_equal([*fleet.true_commands().values()], told), 0.2)
            late_s += [sent_s - due_s, time.monotonic() - due_s, 0.0 if told else np.inf]
            due_s += period_s
        if max(late_s) < 0.03 and np.array_equal(fleet._memory.skipped_s(), frozen_s):
            return np.array(poses)
    pytest.fail("in none of 30 drives did this machine keep the robots' time")


def test_vehicles_move_as_the_stand_in_does_under_the_same_commands(robots, start_fleet, mosquitto, link_to):
    robot, link = robots["mgr"], link_to(mosquitto.broker)
    fleet = start_fleet()
    assert wait_until(lambda: link.announced.keys() == {"1", "2", "3"})
    commands = np.random.default_rng(1).integers(-110, 110, (6, 3, 2)).astype(float)
    poses = driven_in_time(fleet, link, robot.period_s, commands)
    moved = displacement_between(poses[:-1], poses[1:])
    groups = 400
    live = LiveVehicles(robot, "123", groups, 7)
    live.place(np.arange(groups), np.tile([STARTS[v] for v in "123"], (groups, 1, 1)))
    there = [np.moveaxis(live._state[:3], 0, -1)]
    for command in commands:
        live.move(np.tile(command, (groups, 1, 1)))
        there.append(np.moveaxis(live._state[:3], 0, -1))
    expected = displacement_between(np.array(there[:-1]), np.array(there[1:]))
    off_by = np.abs(moved - expected.mean(axis=1))
    late_s = 0.04  # a command is in force a hop and a busy machine's delay later
    allowed = 4.5 * expected.std(axis=1) + late_s * np.array([250.0, 60.0, 7.0])
    assert np.all(off_by < allowed)
    assert np.corrcoef(moved[..., 0].ravel(), expected.mean(axis=1)[..., 0].ravel())[0, 1] > 0.97


def test_robots_with_other_commands_swim_likewise(robots, mosquitto, link_to):
    swim = np.array([0.0, 50.0, 7.0])
    with Fleet(robots["mur"], ("4",), mosquitto.broker, 0, start={"4": (500.0, 500.0, 0.0)}) as fleet:
        link = link_to(mosquitto.broker, "mur")
        drive(link, fleet, swim, "4")
        assert wait_until(lambda: fleet.true_poses()["4"][0] > 540)
        assert Viewer(fleet.camera_url).next()[2].shape == fleet.camera_size[::-1]


def test_pictures_show_the_vehicles_where_they_are_when_they_are_taken(robots, start_fleet, mosquitto, link_to):
    fleet, link = start_fleet(), link_to(mosquitto.broker)
    viewer = Viewer(fleet.camera_url)
    drive(link, fleet, STRAIGHT)
    eye = OverheadCamera(robots["mgr"], tuple("123"), CameraConditions())
    off_by_px = []
    with Watch(fleet) as watch:
        time.sleep(0.5)
        for _ in range(5):
            clocks_s = time.monotonic() - time.time()
            arrived_s, stamp_s, picture = viewer.next()
            assert 0 < arrived_s - stamp_s < 0.5
            found = markers(picture)
            for vehicle, pose in zip(fleet.vehicles, watch.poses(stamp_s + clocks_s), strict=True):
                seen = eye.optics.project(np.append(eye.marker_poses(pose[None])[0, :2], 45.0)[None])[0]
                off_by_px.append(np.linalg.norm(found[int(vehicle)].mean(axis=0) - seen))
    assert np.median(off_by_px) < 0.5
    stamps_s = np.array([one[1] for one in viewer.pictures])
    late_s = 0.2  # the first picture may have been taken later than it was due
    assert (len(stamps_s) - 1) / (stamps_s[-1] - stamps_s[0] + late_s) < 30
    assert (np.diff(stamps_s) > 0).all()


def test_what_a_fleet_is_told_while_it_runs(start_fleet, mosquitto, link_to):
    fleet, link = start_fleet(), link_to(mosquitto.broker)
    viewer, base = Viewer(fleet.camera_url), fleet.camera_url.removesuffix("camera")
    drive(link, fleet, STRAIGHT)
    assert post(base + "place", {"2": [200, 800, 1.0]}) == {"placed": ["2"]}
    np.testing.assert_allclose(fleet.true_poses()["2"], [200, 800, 1.0])
    assert stands(fleet, "2"), "it was switched on anew"
    assert not stands(fleet, "1")
    fleet.place(STARTS)
    assert all(stands(fleet, vehicle, 0.05) for vehicle in "123")
    before = markers(viewer.next()[2])
    fleet.set_faults(camera=CameraFaults(swapped=(("1", "2"),), shift_px=(10.0, -5.0)))
    time.sleep(0.2)
    bumped = markers(viewer.next()[2])
    for number, wearer in ((1, 2), (2, 1), (3, 3)):
        np.testing.assert_allclose(bumped[number].mean(axis=0), np.add(before[wearer].mean(axis=0), (10, -5)), atol=0.5)
    fleet.set_faults(camera=CameraFaults(hidden={"3"}))
    time.sleep(0.2)
    assert markers(viewer.next()[2]).keys() >= {1, 2}
    assert 3 not in markers(viewer.next()[2])
    post(base + "faults", {"robots": {"1": {"deaf": True}}, "camera": {"clock_s": 1000}})
    drive(link, fleet, STRAIGHT, "23")
    assert (fleet.true_commands()["1"] == REST).all()
    assert wait_until(lambda: viewer.pictures[-1][1] > time.time() + 900)
    fleet.set_faults({}, CameraFaults(frozen=True))
    time.sleep(0.3)
    count = len(viewer.pictures)
    assert wait_until(lambda: len(viewer.pictures) > count + 5)
    assert len({jpeg for _, _, jpeg in viewer.pictures[count:]}) == 1
    fleet.set_faults(camera=CameraFaults(silent=True))
    time.sleep(0.3)
    count = len(viewer.pictures)
    time.sleep(0.3)
    assert len(viewer.pictures) == count
    fleet.set_faults(camera=CameraFaults(delay_s=0.3))
    arrived_s, stamp_s, _ = viewer.next()
    assert 0.3 < arrived_s - stamp_s < 0.9
    for path, content, message in (
        ("place", {"9": [0, 0, 0]}, "no vehicle '9'"),
        ("place", {"1": [0, 0]}, "write"),
        ("faults", {"robots": {"1": {"los": 1}}}, "robots.1.los"),
        ("faults", {"camera": {"hidden": ["9"]}}, "no vehicle '9'"),
    ):
        with pytest.raises(urllib.error.HTTPError) as error:
            post(base + path, content)
        assert error.value.code == 400
        assert message in error.value.read().decode()


def test_a_robot_that_is_frozen_stands_still_and_does_not_jump(start_fleet, mosquitto, link_to):
    fleet, link = start_fleet("12"), link_to(mosquitto.broker)
    drive(link, fleet, STRAIGHT, "12")
    time.sleep(0.3)
    os.kill(fleet.robots["1"].pid, signal.SIGSTOP)
    time.sleep(0.1)
    assert stands(fleet, "1", 0.6)
    before, other = fleet.true_poses()["1"], fleet.true_poses()["2"]
    with pytest.raises(TimeoutError, match="does not run"):
        fleet.place({"1": STARTS["1"]}, timeout_s=0.1)
    fleet.set_faults()
    os.kill(fleet.robots["1"].pid, signal.SIGCONT)
    time.sleep(0.05)
    assert np.hypot(*(fleet.true_poses()["1"] - STARTS["1"])[:2]) < 40
    assert np.hypot(*(fleet.true_poses()["2"] - other)[:2]) < 60, "the others went on meanwhile, and no faster"
    assert np.isfinite(before).all()


def test_robots_and_camera_can_be_killed_and_switched_on_again(start_fleet, mosquitto, link_to):
    fleet, link = start_fleet("12"), link_to(mosquitto.broker)
    drive(link, fleet, STRAIGHT, "12")
    time.sleep(0.3)
    os.kill(fleet.robots["1"].pid, signal.SIGKILL)
    assert wait_until(lambda: not fleet.robots["1"].is_running)
    time.sleep(0.05)
    assert stands(fleet, "1")
    assert "gone: 1" in fleet.status()
    before = fleet.true_poses()["1"]
    fleet.restart_robot("1")
    np.testing.assert_allclose(fleet.true_poses()["1"], before, atol=1e-6)
    assert wait_until(lambda: link.announced.get("1", 0) > time.monotonic() - 3)
    drive(link, fleet, STRAIGHT, "12")
    url = fleet.camera_url
    os.kill(fleet.camera.pid, signal.SIGKILL)
    fleet.restart_camera()
    assert fleet.camera_url == url
    assert markers(Viewer(url).next()[2])


@pytest.mark.parametrize("timeout_s", [None, 0.3])
def test_when_commands_stop_vehicles_drive_on_unless_the_firmware_is_patched(
    start_fleet, mosquitto, link_to, timeout_s
):
    fleet, link = start_fleet("1", firmware_timeout_s=timeout_s), link_to(mosquitto.broker)
    drive(link, fleet, STRAIGHT, "1")
    mosquitto.stop()
    time.sleep(0.8)
    assert stands(fleet, "1") == (timeout_s is not None)
    mosquitto.start()
    assert wait_until(lambda: link.is_connected)
    assert wait_until(lambda: "1" in link.announced, 7), "it tries again every five seconds"
    drive(link, fleet, REST, "1")


def test_effects_of_marker_and_camera_show_in_the_pictures(robots, start_fleet):
    fleet = start_fleet(
        "12",
        effects=[{"name": "camera_scale", "scale": 1.05}],
        effects_of={"2": [{"name": "marker_offset", "forward_mm": 20.0, "left_mm": 0.0}]},
    )
    found = markers(Viewer(fleet.camera_url).next()[2])
    eye = OverheadCamera(robots["mgr"], tuple("12"), CameraConditions())
    centre_mm = (robots["mgr"].arena_mm.low_mm + robots["mgr"].arena_mm.high_mm) / 2
    for vehicle, forward_mm in (("1", 0.0), ("2", 20.0)):
        x_mm, y_mm, heading_rad = STARTS[vehicle]
        marker_mm = np.array([x_mm, y_mm]) + forward_mm * np.array([np.cos(heading_rad), np.sin(heading_rad)])
        seen_mm = centre_mm + 1.05 * (marker_mm - centre_mm)
        pixel = eye.optics.project(np.append(seen_mm, 45.0)[None])[0]
        assert np.linalg.norm(found[int(vehicle)].mean(axis=0) - pixel) < 0.7
        assert np.linalg.norm(found[int(vehicle)].mean(axis=0) - eye.optics.project([[x_mm, y_mm, 45.0]])[0]) > 4


def test_a_fleet_that_cannot_be_is_refused_and_leaves_nothing(robots, mosquitto):
    def refused(message, robot="mgr", vehicles=("1", "2"), broker=mosquitto.broker, port=0, **settings):
        with pytest.raises(UserError, match=message):
            Fleet(robots[robot], vehicles, broker, port, FleetSettings(**settings))

    refused("'create' has no stand-in", robot="create")
    refused("'1' is named twice", vehicles=("1", "1"))
    refused("200 of 'mgr' do not fit", vehicles=tuple(map(str, range(200))))
    refused("no broker at", broker=Broker(host="127.0.0.1", port=free_port()))
    refused("timing_jitter' is the host's clock", effects=[{"name": "timing_jitter"}])
    refused("effects_of: there is no vehicle '9'", effects_of={"9": []})
    refused("unknown effect 'batery_sag': did you mean 'battery_sag'", effects=[{"name": "batery_sag"}])
    refused("vehicle '46' has marker 46", vehicles=("1", "46"))
    refused("camera_port=.*Address already in use", port=mosquitto.port)
