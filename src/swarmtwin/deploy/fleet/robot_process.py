"""One emulated robot as a process: firmware on MQTT, and the physics of its vehicle in real time.

One thread does both, as on the real one: it sleeps until the next time step is due or a message comes.
"""

import select
import signal
import time
from typing import Any

import numpy as np
from paho.mqtt.client import Client, MQTTErrorCode

from swarmtwin.deploy.child_process import say_ready, told_by_parent
from swarmtwin.deploy.fleet.emulated_vehicle import EmulatedVehicle
from swarmtwin.deploy.fleet.faulty_path import FaultyPath
from swarmtwin.deploy.fleet.fleet_memory import FleetMemory
from swarmtwin.deploy.fleet.orders import Orders, RobotFaults
from swarmtwin.deploy.link.broker import Broker
from swarmtwin.deploy.link.mqtt_client import make_client
from swarmtwin.robot import Robot
from swarmtwin.standin.effects import parse_effects
from swarmtwin.standin.firmware import Firmware
from swarmtwin.standin.streams import Streams


class RobotProcess:
    """What runs in the process.

    Attributes:
        longest_step_back_s: where the process was kept from running for longer, the vehicle has stood still meanwhile,
            rather than that it makes up for it in a jump.
    """

    longest_step_back_s = 0.1

    def __init__(self, told: dict[str, Any]) -> None:
        robot = Robot.parse(told["robot"], "robot")
        self._memory = FleetMemory(told["vehicles"], told["memory"])
        self._index = told["vehicles"].index(told["vehicle"])
        vehicle, seed = told["vehicle"], told["seed"]
        effects = parse_effects(told["effects"], robot, len(told["vehicles"]))
        self._vehicle = EmulatedVehicle(
            robot, vehicle, effects, seed, told["pose"], told["session_s"], told["wall_mm"], told["obstacles"]
        )
        conditions = self._vehicle.conditions
        usual = RobotFaults(latency_s=conditions.delay_s, loss=conditions.loss_probability)
        self._path = FaultyPath(Streams(seed, f"fleet/{vehicle}").of("link"), usual)
        self._robot, self._timeout_s = robot, told["firmware_timeout_s"]
        self._firmware = Firmware(robot, vehicle, self._timeout_s)
        self._others = np.arange(len(told["vehicles"])) != self._index
        self._session_began_s = told["session_began_s"]
        self._placed = told["placed"]
        self._skipped_s = 0.0
        self._heard = 0
        self._orders_number = -1
        self._connect_again_s = 0.0
        self._broker = Broker.parse(told["broker"], "broker")
        self._client = make_client(self._broker, f"robot-{vehicle}")
        self._client.on_connect = self._on_connect
        self._client.on_message = lambda _, __, message: self._path.put(bytes(message.payload), time.monotonic())

    def run(self) -> None:
        """Drive for ever."""
        next_s = time.monotonic()
        ready = False
        while True:
            now_s = time.monotonic()
            if now_s - next_s > self.longest_step_back_s:
                self._skipped_s += now_s - next_s
                next_s = now_s
            while next_s <= now_s:
                next_s = self._step(next_s)
            if not ready:
                ready = True
                say_ready(step_s=self._vehicle.step_s)
            self._exchange(max(min(next_s, self._path.next_s) - time.monotonic(), 0.0))
            now_s = time.monotonic()
            if now_s < next_s and self._hear(now_s):
                self._vehicle.cut(now_s - (next_s - self._vehicle.step_s))
                next_s = self._step(now_s)

    def _hear(self, now_s: float) -> bool:
        """Take the messages that have come; return whether the vehicle is told something else now."""
        before = self._firmware.command(now_s)
        for message in self._path.due(now_s):
            self._heard += self._firmware.receive(message, now_s)
        return bool((self._firmware.command(now_s) != before).any())

    def _step(self, from_s: float) -> float:
        """Let a time step begin; return when it ends."""
        self._follow_orders()
        self._hear(from_s)
        command = self._firmware.command(from_s)
        others_mm = self._memory.poses(from_s)[self._others, :2]
        start = from_s, self._vehicle.pose.copy()
        self._vehicle.step(command, from_s - self._session_began_s, others_mm)
        end = from_s + self._vehicle.step_s, self._vehicle.pose
        self._memory.write(self._index, start, end, command, self._placed, self._skipped_s, self._heard)
        return end[0]

    def _follow_orders(self) -> None:
        number = self._memory.orders_number
        if number == self._orders_number or (orders := self._memory.orders()) is None:
            return
        self._orders_number = number
        self._obey(orders)

    def _obey(self, orders: Orders) -> None:
        vehicle = self._firmware.vehicle
        self._path.faults = orders.robots.get(vehicle, RobotFaults())
        if orders.placement_number(vehicle) > self._placed:
            self._placed = orders.placement_number(vehicle)
            self._vehicle.place(orders.placements[vehicle].pose)
            self._path.clear()
            self._firmware = Firmware(self._robot, vehicle, self._timeout_s)
            self._announce()

    def _exchange(self, timeout_s: float) -> None:
        """Let messages in and out, for no longer than until the next time step."""
        opened = self._client.socket()
        if opened is None:
            self._connect()
            time.sleep(max(min(timeout_s, self._vehicle.step_s), 0.0))
            return
        writing = [opened] if self._client.want_write() else []
        pending = getattr(opened, "pending", lambda: 0)()
        readable, writable, _ = select.select([opened], writing, [], 0 if pending else timeout_s)
        if readable or pending:
            self._client.loop_read()
        if writable and self._client.socket() is not None:
            self._client.loop_write()
        self._client.loop_misc()

    def _connect(self) -> None:
        now_s = time.monotonic()
        if now_s < self._connect_again_s:
            return
        self._connect_again_s = now_s + self._firmware.reconnect_s
        try:
            self._client.connect(self._broker.host, self._broker.port, keepalive=5)
        except OSError:
            return

    def _on_connect(self, client: Client, *_: Any) -> None:
        if client.subscribe(self._firmware.topic, 0)[0] == MQTTErrorCode.MQTT_ERR_SUCCESS:
            self._announce()

    def _announce(self) -> None:
        if self._firmware.announcement:
            self._client.publish(*self._firmware.announcement, qos=0)


def main() -> None:
    """Be a robot until the parent ends."""
    signal.signal(signal.SIGPIPE, signal.SIG_IGN)
    RobotProcess(told_by_parent()).run()


if __name__ == "__main__":
    main()
