"""Vehicles, a camera and a link in memory, in real time: everything of a deployment that is not under test."""

import threading
import time

import numpy as np
import torch

from exact_model import simulation_with
from swarmtwin.deploy.camera.camera import CameraLostError, Frame
from swarmtwin.deploy.control.controller import Controller
from swarmtwin.deploy.control.effect_time import EffectTimePredictor
from swarmtwin.deploy.control.journal import Journal
from swarmtwin.deploy.control.look_ahead import LookAhead
from swarmtwin.deploy.control.observer import Observer
from swarmtwin.deploy.control.outcome import Watchmen
from swarmtwin.deploy.control.safety import SafetyFilter
from swarmtwin.deploy.control.settings import SafetySettings, TimingSettings
from swarmtwin.deploy.control.stop_conditions import StopConditions
from swarmtwin.deploy.link.link import LinkLostError
from swarmtwin.deploy.tracking.sighting import Sighting
from swarmtwin.dynamics.motion_noise import MotionNoise
from swarmtwin.geometry import compose, exp_map
from tiny_policies import robot_named

NOISE = MotionNoise(
    at_rest=(0.25, 0.04, 1e-4),
    with_motion=(0.3, 0.05, 1e-4),
    usual_mm=20.0,
    usual_rad=0.3,
    camera=(0.01, 0.01, 1e-5),
)
SAFETY = SafetySettings(separation_mm=110.0, standstill_s=0.2, standstill_wait_s=1.5, too_near_mm=90.0)


def quick_robot(period_s=0.1):
    """The MGR with a short period, so that a test takes no time; its speeds grow accordingly."""
    return robot_named("mgr").model_copy(update={"period_s": period_s, "longest_gap_s": 1.2 * period_s})


def exact_simulation(robot, **mechanisms):
    """What moves the vehicles of a playground, exactly."""
    return simulation_with(robot, motion_noise=NOISE, **mechanisms)


class Vehicles:
    """V vehicles that move by a simulation's steady twists under the last command, as long as it lasts: a link, too.

    Attributes:
        robot: their robot.
        ids: of the vehicles.
        strength: factor on the motion of each, (V,).
        lost: whether the link is down.
        interruptions: how often it was.
        heard: every command that arrived: (when, {vehicle: command}).
        deaf: vehicles that hear nothing any more.
    """

    def __init__(self, simulation, pose, ids=None):
        self.robot = simulation.robot
        self.ids = tuple(ids or (str(index + 1) for index in range(len(pose))))
        self.strength = np.ones(len(pose))
        self.lost = False
        self.interruptions = 0
        self.deaf = set()
        self.heard = []
        self.announced = {}
        self._dynamics = simulation.dynamics
        self._pose = np.array(pose, float)
        self._command = np.tile(self.robot.command_at_rest, (len(pose), 1))
        self._at_s = time.monotonic()
        self._lock = threading.Lock()

    @property
    def is_connected(self):
        return not self.lost

    def send(self, commands):
        if self.lost:
            raise LinkLostError("no connection to the vehicles")
        now_s = time.monotonic()
        self.poses(now_s)
        with self._lock:
            for vehicle, command in commands.items():
                low, high = self.robot.command_low, self.robot.command_high
                if not ((command >= low) & (command <= high)).all():
                    raise ValueError(f"{vehicle}: {command} is not bounded")
                if vehicle not in self.deaf:
                    self._command[self.ids.index(vehicle)] = command
            self.heard.append((now_s, {vehicle: np.array(command) for vehicle, command in commands.items()}))
        return now_s

    def poses(self, now_s=None):
        """True poses (V, 3) now."""
        with self._lock:
            now_s = now_s or time.monotonic()
            if now_s > self._at_s:
                twist = self._dynamics.twist(torch.as_tensor(self._command)).numpy() * self.strength[:, None]
                self._pose = compose(self._pose, exp_map(twist * (now_s - self._at_s) / self.robot.period_s))
                self._at_s = now_s
            return self._pose.copy()

    def close(self):
        pass


class MemoryCamera:
    """A camera that takes a picture of nothing at a steady pace; `FlawlessTracker` knows what would be on it."""

    source = "memory"
    size = (4, 4)
    is_live = True

    def __init__(self, pictures_s=0.02):
        self.pictures_s = pictures_s
        self.broken = False
        self._number = 0

    def next_frame(self, after=-1, timeout_s=1.0):
        time.sleep(self.pictures_s)
        if self.broken:
            time.sleep(timeout_s)
            raise CameraLostError("memory: unplugged")
        self._number += 1
        return Frame(self._number, time.monotonic(), np.zeros((4, 4), np.uint8))

    def close(self):
        pass


class FlawlessTracker:
    """Sees where the vehicles were when the picture was taken, but for those hidden."""

    def __init__(self, vehicles, noise_mm=0.1, late_s=0.0):
        self.vehicles = vehicles
        self.hidden = set()
        self.noise_mm = noise_mm
        self.late_s = late_s
        self._rng = np.random.default_rng(1)

    def track(self, frame):
        pose = self.vehicles.poses(frame.captured_s)
        pose[:, :2] += self._rng.normal(0, self.noise_mm, (len(pose), 2))
        time.sleep(self.late_s)
        seen = {one: pose[index] for index, one in enumerate(self.vehicles.ids) if one not in self.hidden}
        return Sighting(frame.number, frame.captured_s, seen)


class Told:
    """A driver that wants the same commands all the time, or what a function says."""

    def __init__(self, wanted):
        self.wanted = wanted

    def start(self, pose):
        pass

    def decide(self, pose):
        return self.wanted(pose) if callable(self.wanted) else np.array(self.wanted, float)

    def moved(self, command, pose):
        return None

    def shown(self):
        return {}


class Playground:
    """A controller over vehicles in memory."""

    def __init__(self, folder, pose, robot=None, watchmen=None, simulation=None, **safety):
        self.robot = robot or quick_robot()
        self.simulation = simulation or exact_simulation(self.robot)
        self.vehicles = Vehicles(self.simulation, pose)
        self.camera = MemoryCamera()
        self.tracker = FlawlessTracker(self.vehicles)
        self.settings = SAFETY.model_copy(update=safety)
        self.observer = Observer(self.camera, self.tracker, self.vehicles.ids, picture_timeout_s=0.3)
        self.predictor = EffectTimePredictor(self.simulation, len(pose))
        arena = self.robot.arena_mm
        ahead = LookAhead(self.simulation, self.settings.look_ahead_periods, self.settings.unknown_spread)
        self.filter = SafetyFilter(
            self.robot, arena, self.vehicles.ids, ahead, self.settings, self.settings.separation_mm
        )
        self.conditions = StopConditions(self.robot, arena, self.vehicles.ids, self.settings, self.settings.too_near_mm)
        self.journal = Journal(folder / "journal.jsonl", 2**20)
        self.controller = Controller(
            self.vehicles.ids,
            self.vehicles,
            self.observer,
            self.predictor,
            self.filter,
            self.conditions,
            self.journal,
            watchmen or Watchmen(),
            (self.settings, TimingSettings(beat_s=0.01)),
        )

    def __enter__(self):
        self.observer.start()
        until_s = time.monotonic() + 2
        while len(self.observer.newest()) < len(self.vehicles.ids) and time.monotonic() < until_s:
            time.sleep(0.01)
        return self

    def __exit__(self, *_):
        self.observer.close()
        self.journal.close()

    def drive(self, driver, periods=20, then=None, after_s=0.5):
        """Drive; meanwhile, after so many seconds, do something to it. Return the outcome."""
        if then is not None:
            threading.Timer(after_s, then).start()
        return self.controller.run(driver, periods)

    def first_zeros_after(self, moment_s):
        """How long after a moment the first message arrived that tells all vehicles to stand."""
        rest = self.robot.command_at_rest
        for heard_s, commands in self.vehicles.heard:
            if heard_s >= moment_s and all((command == rest).all() for command in commands.values()):
                return heard_s - moment_s
        return np.inf
