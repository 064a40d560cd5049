"""What can be brought into a running deployment: each kind of fault once, and what must come of it."""

import contextlib
import os
import random
import signal
import time
import urllib.request
from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np
from fault_scene import Scene
from paho.mqtt.client import Client, MQTTv311
from paho.mqtt.enums import CallbackAPIVersion

from swarmtwin.deploy.fleet.orders import CameraFaults, RobotFaults

TakeAway = Callable[[], None]


class FaultKind(NamedTuple):
    """One kind of fault.

    Attributes:
        bring: brings it into a scene, by chance; returns what takes it away.
        lasts_s: between which times it lasts.
        delays_s: by how much at most it delays a command on its way to a robot.
        hinders: whether robots may not hear a command until it is taken away.
        must_be_answered: whether all vehicles must be told to stand within a period.
        only_by_firmware: whether no host can do that, and robots with a time-out do.
        not_after: names of kinds after which it cannot be brought in.
    """

    bring: Callable[[Scene, random.Random], TakeAway]
    lasts_s: tuple[float, float] = (0.2, 0.9)
    delays_s: float = 0.0
    hinders: bool = False
    must_be_answered: bool = False
    only_by_firmware: bool = False
    not_after: tuple[str, ...] = ()


def robots(scene: Scene, rng: random.Random, **fault: Any) -> TakeAway:
    """Let something go wrong with the commands to all robots, or to one."""
    chosen = scene.fleet.vehicles if rng.random() < 0.5 else [rng.choice(scene.fleet.vehicles)]
    scene.fleet.set_faults(robots={vehicle: RobotFaults(**fault) for vehicle in chosen})
    return lambda: scene.fleet.set_faults(robots={})


def camera(scene: Scene, **fault: Any) -> TakeAway:
    """Let something go wrong with the pictures."""
    scene.fleet.set_faults(camera=CameraFaults(**fault))
    return lambda: scene.fleet.set_faults(camera=CameraFaults())


def hide(scene: Scene, rng: random.Random) -> TakeAway:
    """Cover a vehicle's marker."""
    return camera(scene, hidden=frozenset({rng.choice(scene.fleet.vehicles)}))


def signalled(process: int, number: signal.Signals) -> TakeAway:
    """Send a process a signal; it is woken afterwards."""

    def send(which: signal.Signals) -> None:
        if process:
            with contextlib.suppress(ProcessLookupError):
                os.kill(process, which)

    send(number)
    return lambda: send(signal.SIGCONT)


def freeze_robot(scene: Scene, rng: random.Random) -> TakeAway:
    """Let a robot's firmware hang."""
    return signalled(scene.fleet.robots[rng.choice(scene.fleet.vehicles)].pid, signal.SIGSTOP)


def say(scene: Scene, payload: bytes) -> TakeAway:
    """Let somebody else send a message to the vehicles."""
    scene.own.append(payload)
    stranger = Client(CallbackAPIVersion.VERSION2, "stranger", protocol=MQTTv311)
    stranger.connect("127.0.0.1", scene.broker.port)
    stranger.loop_start()
    stranger.publish(scene.robot.link.command_topic, payload).wait_for_publish(1)
    stranger.disconnect()
    stranger.loop_stop()
    return lambda: None


def command_by_another(scene: Scene, rng: random.Random, left: float, right: float) -> TakeAway:
    """Let somebody else command one of the vehicles."""
    messages = scene.message_format.messages({rng.choice(scene.fleet.vehicles): np.array([left, right]).round()})
    return say(scene, next(iter(messages.values())))


def fill_disk(scene: Scene, rng: random.Random) -> TakeAway:
    """Fill the disk; somebody makes room again, or nobody does."""
    scene.filled = scene.project / "filling"
    scene.was_full = True
    with scene.filled.open("wb") as file, contextlib.suppress(OSError):
        while True:
            file.write(bytes(1 << 16))
            file.flush()
    return scene.free_disk if rng.random() < 0.5 else lambda: None


def restart_broker(scene: Scene, rng: random.Random) -> TakeAway:
    """Let the broker end, and start it again at once."""
    scene.broker.stop()
    time.sleep(rng.uniform(0, 0.1))
    scene.broker.start()
    return lambda: None


def freeze_broker(scene: Scene, rng: random.Random) -> TakeAway:
    """Let the broker hang."""
    scene.broker.freeze()
    return scene.broker.thaw


def kill_broker(scene: Scene, rng: random.Random) -> TakeAway:
    """Let the broker end."""
    scene.broker.stop()
    return lambda: None


def press_button(scene: Scene, rng: random.Random) -> TakeAway:
    """Press the red button of the live view, whose address the deployment has said."""
    said = (scene.project.parent / "error").read_text(errors="replace")
    address = said.rpartition("live view with a stop button: ")[2].split()[0]
    urllib.request.urlopen(address + "stop", data=b"", timeout=5).close()
    return lambda: None


def frozen(which: Callable[[Scene], int], lasts_s: tuple[float, float], answered: bool = False) -> FaultKind:
    """Return the kind of fault in which a process hangs for a while."""
    return FaultKind(
        lambda scene, rng: signalled(which(scene), signal.SIGSTOP), lasts_s=lasts_s, must_be_answered=answered
    )


def sent(which: Callable[[Scene], int], number: signal.Signals) -> FaultKind:
    """Return the kind of fault in which a process is sent a signal that ends it; it must be answered."""
    return FaultKind(lambda scene, rng: signalled(which(scene), number), must_be_answered=True)


def controller(scene: Scene) -> int:
    """Return the process id of the controller."""
    return scene.controller


def supervisor(scene: Scene) -> int:
    """Return that of the supervisor."""
    return scene.child("control.supervisor")


def live_view(scene: Scene) -> int:
    """Return that of the live view."""
    return scene.child("live_view")


SHORT_S = (0.03, 0.2)
LONG_S = (0.9, 2.0)
SURVIVABLE: dict[str, FaultKind] = {
    "commands late": FaultKind(lambda scene, rng: robots(scene, rng, latency_s=rng.uniform(0, 0.2)), delays_s=0.2),
    "commands late by chance, overtaking": FaultKind(
        lambda scene, rng: robots(scene, rng, jitter_s=rng.uniform(0.1, 0.7)), delays_s=0.7
    ),
    "commands lost": FaultKind(lambda scene, rng: robots(scene, rng, loss=rng.uniform(0.05, 0.5)), delays_s=0.4),
    "commands twice": FaultKind(lambda scene, rng: robots(scene, rng, duplicate=0.5, jitter_s=0.1), delays_s=0.2),
    "commands in another order": FaultKind(lambda scene, rng: robots(scene, rng, reorder=0.3), delays_s=0.2),
    "pictures lost": FaultKind(lambda scene, rng: camera(scene, drop=rng.uniform(0.1, 0.6))),
    "pictures late": FaultKind(lambda scene, rng: camera(scene, delay_s=rng.uniform(0.02, 0.12))),
    "camera silent for a moment": FaultKind(lambda scene, rng: camera(scene, silent=True), SHORT_S),
    "camera frozen for a moment": FaultKind(lambda scene, rng: camera(scene, frozen=True), SHORT_S),
    "camera's clock steps": FaultKind(
        lambda scene, rng: camera(scene, clock_s=rng.choice((-1, 1)) * 10 ** rng.uniform(-1, 6))
    ),
    "marker hidden for a moment": FaultKind(hide, SHORT_S),
    "controller frozen for a moment": frozen(controller, SHORT_S),
    "supervisor frozen for a moment": frozen(supervisor, SHORT_S),
    "broker frozen for a moment": FaultKind(freeze_broker, (0.03, 0.15), delays_s=0.15),
    "live view frozen": frozen(live_view, (0.2, 0.9)),
    "live view killed": FaultKind(lambda scene, rng: signalled(live_view(scene), signal.SIGKILL)),
    "robot frozen for a while": FaultKind(freeze_robot, hinders=True),
    "another's zeros": FaultKind(lambda scene, rng: command_by_another(scene, rng, 0, 0), SHORT_S),
    "disk full": FaultKind(fill_disk),
}
TO_BE_ANSWERED: dict[str, FaultKind] = {
    "camera silent": FaultKind(lambda scene, rng: camera(scene, silent=True), LONG_S, must_be_answered=True),
    "camera frozen": FaultKind(lambda scene, rng: camera(scene, frozen=True), LONG_S, must_be_answered=True),
    "camera killed": sent(lambda scene: scene.fleet.camera.pid, signal.SIGKILL),
    "pictures much too late": FaultKind(
        lambda scene, rng: camera(scene, delay_s=rng.uniform(0.6, 3)), LONG_S, must_be_answered=True
    ),
    "marker hidden": FaultKind(hide, LONG_S, must_be_answered=True),
    "controller frozen": frozen(controller, LONG_S, answered=True),
    "controller killed": sent(controller, signal.SIGKILL),
    "controller interrupted": sent(controller, signal.SIGINT),
    "controller terminated": sent(controller, signal.SIGTERM),
    "supervisor frozen": frozen(supervisor, LONG_S, answered=True),
    "supervisor killed": sent(supervisor, signal.SIGKILL),
    "another controller": FaultKind(
        lambda scene, rng: command_by_another(scene, rng, rng.uniform(30, 120), rng.uniform(-120, -30)),
        must_be_answered=True,
    ),
    "nonsense on the topic": FaultKind(lambda scene, rng: say(scene, rng.randbytes(20)), must_be_answered=True),
    "red button": FaultKind(press_button, must_be_answered=True, not_after=("live view killed",)),
    "broker restarted": FaultKind(restart_broker, must_be_answered=True, only_by_firmware=True),
    "broker frozen": FaultKind(freeze_broker, LONG_S, must_be_answered=True, only_by_firmware=True),
    "broker killed": FaultKind(kill_broker, LONG_S, must_be_answered=True, only_by_firmware=True),
}
KINDS = SURVIVABLE | TO_BE_ANSWERED
