"""What runs on a vehicle: it reads its commands and drives by the last one. MQTT itself is somebody else's.

Written from what the hardware does, not from how the host writes: a host that writes nonsense finds out here.
"""

import json
import math
from typing import Any

import numpy as np

from swarmtwin.errors import UserError
from swarmtwin.robot import Robot


class Firmware:
    """The published firmware: its own id's numbers in the group's JSON, held until the next, without any time-out.

    Patched with a time-out it stops by itself; so do robots whose file says so. Robots with other messages are read as
    their file says. Where a number is a PWM, its sign is the direction and it fills eight bits; others end at the
    robot's limits, as a servo does.

    Attributes:
        vehicle: its id.
        topic: where its commands come.
        announcement: the topic and the payload by which it says that it is there; None: it does not.
        timeout_s: it stops when no command has come for so long; None: it drives on.
        reconnect_s: how long it waits before it tries to connect again.
        largest_pwm: the largest that it can give.
    """

    def __init__(
        self,
        robot: Robot,
        vehicle: str,
        timeout_s: float | None = None,
        reconnect_s: float = 5.0,
        largest_pwm: float = 255.0,
    ) -> None:
        """Switch it on: it stands still.

        Raises:
            UserError: the robot's file does not say how it is spoken to.
        """
        if robot.link is None:
            raise UserError(f"robot {robot.name!r} cannot be spoken to: its file in conf/robot/ has no `link:`")
        self.vehicle = vehicle
        self.timeout_s = timeout_s
        self.reconnect_s = reconnect_s
        self.topic = robot.link.command_topic.replace("{vehicle}", vehicle)
        topic = robot.link.announce_topic
        self.announcement = None if topic is None else (topic, vehicle.encode())
        self._reads_group = self.topic == robot.link.command_topic
        self._fields = tuple(robot.link.fields.values())
        is_pwm = np.array([column.unit == "PWM" for column in robot.command.values()])
        self._low = np.where(is_pwm, -largest_pwm, robot.command_low)
        self._high = np.where(is_pwm, largest_pwm, robot.command_high)
        self._at_rest = robot.command_at_rest
        self._held = self._at_rest
        self._heard_s = -math.inf

    def receive(self, payload: bytes, now_s: float) -> bool:
        """Take a message on its topic, in force from now on; return whether it was one for this vehicle.

        What is no JSON, has nothing for this vehicle or lacks a number is ignored, and what held goes on.
        """
        try:
            content = json.loads(payload)
        except (ValueError, RecursionError):
            return False
        if self._reads_group:
            content = content.get(self.vehicle) if isinstance(content, dict) else None
        if not isinstance(content, dict):
            return False
        numbers = [_number(content.get(field.key), field.decimals) for field in self._fields]
        if None in numbers:
            return False
        offset = np.array([field.offset for field in self._fields])
        factor = np.array([field.factor for field in self._fields])
        self._held = np.clip((np.array(numbers, float) - offset) / factor, self._low, self._high)
        self._heard_s = now_s
        return True

    def command(self, now_s: float) -> np.ndarray:
        """Return what the actuators are told now, (m,), in the robot's units."""
        if self.timeout_s is not None and now_s - self._heard_s > self.timeout_s:
            return self._at_rest
        return self._held


def _number(value: Any, decimals: int) -> float | None:
    """Return a number as the firmware reads it: a whole one without its fraction; None where it is none."""
    if isinstance(value, bool) or not isinstance(value, int | float) or not abs(value) < 1e9:
        return None
    return float(value) if decimals else float(math.trunc(value))
