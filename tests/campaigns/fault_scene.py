"""Where deployments with faults take place: a real mosquitto, an emulated fleet, and a witness of what happens."""

import contextlib
import os
import signal
import sys
import threading
import time
from pathlib import Path

import numpy as np
from paho.mqtt.client import Client, MQTTv311
from paho.mqtt.enums import CallbackAPIVersion

REPOSITORY = Path(__file__).resolve().parents[2]
sys.path.insert(0, str(REPOSITORY / "tests" / "deploy"))

from real_broker import Mosquitto  # noqa: E402

from swarmtwin.deploy.fleet.fleet import Fleet, FleetSettings  # noqa: E402
from swarmtwin.deploy.fleet.orders import CameraFaults  # noqa: E402
from swarmtwin.deploy.link.message_format import MessageFormat  # noqa: E402
from swarmtwin.robot import Robot  # noqa: E402


class Scene:
    """What a drive takes place in: broker, fleet, and the process that drives.

    Attributes:
        project: folder in which the process drives.
        controller: process id of `swarmtwin deploy`.
        own: payloads that the campaign has sent itself.
        filled: the file that fills the disk; None: it is not full.
        was_full: whether the disk was full at any time of this drive.
    """

    def __init__(self, place: Path, project: Path, firmware_timeout_s: float | None, seed: int) -> None:
        self.project = project
        self.robot = Robot.load(REPOSITORY / "conf" / "robot" / "mgr.yaml")
        self.broker = Mosquitto(place)
        vehicles = tuple(str(1 + index) for index in range(5))
        settings = FleetSettings(seed=seed, firmware_timeout_s=firmware_timeout_s)
        self.fleet = Fleet(self.robot, vehicles, self.broker.broker, 0, settings)
        self.message_format = MessageFormat(self.robot)
        self.firmware = "time-out" if firmware_timeout_s else "published"
        self.controller = 0
        self.own: list[bytes] = []
        self.filled: Path | None = None
        self.was_full = False

    def child(self, module: str) -> int:
        """Return the process id of the controller's child that runs a module; 0: there is none."""
        for entry in Path("/proc").iterdir():
            with contextlib.suppress(OSError, ValueError, IndexError):
                parent = int((entry / "stat").read_text().rpartition(")")[2].split()[1])
                if parent == self.controller and module in (entry / "cmdline").read_text():
                    return int(entry.name)
        return 0

    def commands(self, payload: bytes) -> dict[str, np.ndarray]:
        """Return what a message tells each vehicle; nothing where the campaign has sent it, or nobody can read it."""
        if payload in self.own:
            return {}
        return self.message_format.commands(self.robot.link.command_topic, payload)

    def free_disk(self) -> None:
        """Let there be room on the disk again."""
        if self.filled:
            self.filled.unlink(missing_ok=True)
            self.filled = None

    def repair(self) -> None:
        """Put everything right again that a fault has broken."""
        self.broker.thaw()
        if not self.broker._listens():
            self.broker.start()
        self.fleet.set_faults({}, CameraFaults())
        for process in (self.fleet.camera, *self.fleet.robots.values()):
            with contextlib.suppress(ProcessLookupError):
                os.kill(process.pid, signal.SIGCONT)
        if not self.fleet.camera.is_running:
            self.fleet.restart_camera()
        for vehicle, process in list(self.fleet.robots.items()):
            if not process.is_running:
                self.fleet.restart_robot(vehicle)
        self.free_disk()
        self.own.clear()
        self.was_full = False

    def close(self) -> None:
        """Let all go."""
        self.repair()
        self.fleet.close()
        self.broker.stop()


class Witness:
    """Sees all messages on the topic of commands, and every 0.01 s where vehicles are and what they are told.

    Attributes:
        messages: (when, payload) in order.
        moments: when it looked.
        poses: (V, 3) true poses at each moment.
        told: (V, m) what the actuators were told at each moment.
    """

    def __init__(self, scene: Scene) -> None:
        self.scene = scene
        self.messages: list[tuple[float, bytes]] = []
        self.moments: list[float] = []
        self.poses: list[np.ndarray] = []
        self.told: list[np.ndarray] = []
        self._ends = threading.Event()
        self._client = Client(CallbackAPIVersion.VERSION2, "witness", protocol=MQTTv311)
        self._client.on_connect = lambda client, *_: client.subscribe(scene.robot.link.command_topic)
        self._client.on_message = lambda _, __, message: self.messages.append(
            (time.monotonic(), bytes(message.payload))
        )
        self._client.reconnect_delay_set(1, 1)
        self._client.connect("127.0.0.1", scene.broker.port)
        self._client.loop_start()
        self._thread = threading.Thread(target=self._look)
        self._thread.start()

    def moves(self, within: int = 3) -> bool:
        """Whether any vehicle was told to move the last few times it looked."""
        return any(told.any() for told in self.told[-within:])

    def orders_after(self, since_s: float) -> bool:
        """Whether the controller has told vehicles to move since a moment."""
        heard = [payload for when_s, payload in self.messages[-40:] if when_s > since_s]
        return any(command.any() for payload in heard for command in self.scene.commands(payload).values())

    def close(self) -> None:
        """Look no longer."""
        self._ends.set()
        self._thread.join()
        self._client.disconnect()
        self._client.loop_stop()

    def _look(self) -> None:
        while not self._ends.wait(0.01):
            self.moments.append(time.monotonic())
            self.poses.append(np.array([*self.scene.fleet.true_poses().values()]))
            self.told.append(np.array([*self.scene.fleet.true_commands().values()]))
