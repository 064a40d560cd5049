"""The supervisor: a process of its own that stops the vehicles when the controller freezes or dies.

It is started first, has its own connection to the vehicles, imports little, and knows nothing but how long the
controller may be silent. `python -m swarmtwin.deploy.control.supervisor` reads its orders as JSON from its standard
input and then watches that pipe, too: it ends when the controller does, however that ends.
"""

import importlib
import json
import os
import select
import signal
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path
from typing import Any

from swarmtwin.deploy.control.heartbeat import Heartbeat, LatchReason, Phase
from swarmtwin.deploy.link.broker import Broker
from swarmtwin.deploy.link.link import Link, LinkLostError
from swarmtwin.deploy.link.mqtt_link import connect
from swarmtwin.robot import Robot, StrictModel


class Orders(StrictModel):
    """What a supervisor is told at its start.

    Attributes:
        heartbeat: path of the shared file.
        vehicles: ids of those that it stops.
        silence_s: how long the controller may be silent.
        zeros_every_s: how often a stop is repeated.
        stops_for_s: how long it is repeated after the controller has died.
        log: file to which it writes what it did, one JSON a line.
        recover: the output folder whose recording it finishes when the controller has died; null: none.
        link: how to connect, for `connect_by`.
    """

    heartbeat: Path
    vehicles: tuple[str, ...]
    silence_s: float
    zeros_every_s: float
    stops_for_s: float = 3.0
    log: Path
    recover: Path | None = None
    link: dict[str, Any]


class Supervisor:
    """Watches the controller's heartbeat, and sends zeros where it must."""

    def __init__(self, orders: Orders, link: Link, controller_lives: Callable[[float], bool]) -> None:
        """Prepare to watch.

        Args:
            orders: what to watch.
            link: connected to the vehicles.
            controller_lives: waits so many seconds or less, and says whether the controller is still there.
        """
        self.orders = orders
        self.link = link
        self.heartbeat = Heartbeat.open(orders.heartbeat)
        self._controller_lives = controller_lives
        self._zeros = dict.fromkeys(orders.vehicles, link.robot.command_at_rest)
        self._plain_zeros = {vehicle: zeros.tolist() for vehicle, zeros in self._zeros.items()}
        self._last_zeros_s = -float("inf")
        self._log = orders.log.open("a", buffering=1)

    def run(self) -> bool:
        """Watch until the controller has ended; return whether it died while driving."""
        self.heartbeat.write("supervisor_ready", 1)
        while True:
            now_s = time.monotonic()
            self.heartbeat.write("supervisor_beat_s", now_s)
            self.heartbeat.write("supervisor_connected", float(self.link.is_connected))
            if not self._controller_lives(min(0.01, self.orders.zeros_every_s)):
                return self._after_death()
            if self.heartbeat.phase == Phase.ENDED:
                continue
            if self.heartbeat.read("ask_supervisor"):
                self.heartbeat.latch(LatchReason.ASKED, now_s)
            if self.heartbeat.phase == Phase.DRIVING and self._silence_s() > self.orders.silence_s:
                self._latch(LatchReason.FROZE)
            if self.heartbeat.latched:
                self._send_zeros()

    def _silence_s(self) -> float:
        return time.monotonic() - self.heartbeat.read("controller_beat_s")

    def _latch(self, reason: str) -> None:
        if self.heartbeat.latched is None:
            self.heartbeat.latch(reason, time.monotonic())
            self._write(event="latched", reason=reason, silence_s=self._silence_s())

    def _after_death(self) -> bool:
        """Stop the vehicles for a while, unless the controller had nothing moving."""
        if self.heartbeat.phase in (Phase.PREPARING, Phase.ENDED):
            return False
        self._latch(LatchReason.DIED)
        until_s = time.monotonic() + self.orders.stops_for_s
        while time.monotonic() < until_s:
            self._send_zeros()
            time.sleep(self.orders.zeros_every_s / 2)
        return True

    def _send_zeros(self) -> None:
        now_s = time.monotonic()
        if now_s - self._last_zeros_s < self.orders.zeros_every_s:
            return
        self._last_zeros_s = now_s
        with suppress(LinkLostError):  # the connection comes back by itself, and then the next ones go through
            self._write(event="zeros", sent_s=self.link.send(self._zeros), sent=self._plain_zeros)

    def _write(self, **what: Any) -> None:
        with suppress(OSError):  # a full disk must not keep the vehicles moving
            self._log.write(json.dumps(what) + "\n")


class SupervisorProcess:
    """The controller's side of a supervisor."""

    def __init__(self, orders: Orders) -> None:
        """Start it; `wait_until_ready` before anything moves."""
        command = [sys.executable, "-m", "swarmtwin.deploy.control.supervisor"]
        self._complaints = tempfile.TemporaryFile("w+")  # noqa: SIM115 - nobody reads a pipe of a dead controller
        self.process = subprocess.Popen(
            command, stdin=subprocess.PIPE, stderr=self._complaints, text=True, start_new_session=True
        )
        assert self.process.stdin
        self.process.stdin.write(orders.model_dump_json() + "\n")
        self.process.stdin.flush()

    @property
    def pid(self) -> int:
        """Its process id."""
        return self.process.pid

    def wait_until_ready(self, heartbeat: Heartbeat, timeout_s: float = 15.0) -> str | None:
        """Wait until it watches; return what went wrong, or None."""
        until_s = time.monotonic() + timeout_s
        while not heartbeat.read("supervisor_ready"):
            if self.process.poll() is not None:
                self._complaints.seek(0)
                lines = self._complaints.read().strip().splitlines()
                return lines[-1] if lines else f"it ended with status {self.process.returncode}"
            if time.monotonic() > until_s:
                return f"it was not ready within {timeout_s:g} s"
            time.sleep(0.01)
        return None

    def is_alive(self) -> bool:
        """Return whether the process is there."""
        return self.process.poll() is None

    def close(self) -> None:
        """Let it go: it ends when the pipe closes."""
        assert self.process.stdin
        with suppress(OSError):
            self.process.stdin.close()
        try:
            self.process.wait(5)
        except subprocess.TimeoutExpired:  # it was frozen, say
            self.process.kill()
            self.process.wait()
        self._complaints.close()


def connect_by(description: dict[str, Any], name: str) -> Link:
    """Connect to the vehicles as a description of plain data says: `{factory: module:function, ...}`, the rest its own.

    It is written by the controller, never by a file from outside.
    """
    module, function = description["factory"].split(":")
    others = {key: value for key, value in description.items() if key != "factory"}
    link: Link = getattr(importlib.import_module(module), function)(name=name, **others)
    return link


def main() -> None:
    """Watch the controller that has started this process."""
    for interrupt in (signal.SIGINT, signal.SIGTERM, signal.SIGHUP):  # Ctrl-C is the controller's to answer
        signal.signal(interrupt, signal.SIG_IGN)
    text = b""
    while not text.endswith(b"\n"):
        if not (more := os.read(0, 1 << 16)):
            return
        text += more
    orders = Orders.model_validate_json(text)
    link = connect_by(orders.link, "supervisor")
    died = Supervisor(orders, link, _pipe_is_open).run()
    link.close()
    if died and orders.recover is not None:
        arguments = [sys.executable, "-m", "swarmtwin.deploy.control.recovery", str(orders.recover)]
        subprocess.run(arguments, stdin=subprocess.DEVNULL, check=False)


def _pipe_is_open(timeout_s: float) -> bool:
    """Wait so long; return whether the controller still holds its end of the pipe, into which it writes no more."""
    readable, _, _ = select.select([0], [], [], timeout_s)
    return not readable or bool(os.read(0, 1))


def mqtt_link(name: str, robot: dict[str, Any], broker: dict[str, Any]) -> Link:
    """Connect through a broker; the robot with its link, and what `Broker.at` wants, as plain data."""
    password_file, ca_file = (Path(path) if path else None for path in (broker["password_file"], broker["ca_file"]))
    where = Broker.at(broker["address"], password_file, ca_file)
    return connect(Robot.parse(robot, "robot"), where, name)


if __name__ == "__main__":
    main()
