"""Commands as JSON messages and back, as the robot's file says (`link:`)."""

import json
from collections.abc import Mapping
from typing import Any

import numpy as np

from swarmtwin.errors import UserError
from swarmtwin.robot import Robot


class MessageFormat:
    """How commands to the vehicles of one robot are written.

    Attributes:
        robot: whose commands they are.
        topic_filter: what to subscribe to for the commands of all vehicles.
        announce_topic: where vehicles say that they are there; None: they do not.
    """

    def __init__(self, robot: Robot) -> None:
        """Take the format from the robot's file.

        Raises:
            UserError: the file has no `link`, or numbers too coarse to send any command, or one at rest.
        """
        if robot.link is None:
            raise UserError(f"robot {robot.name!r} cannot be spoken to: its file in conf/robot/ has no `link:`")
        self.robot = robot
        self._link = robot.link
        fields = robot.link.fields.values()
        self._factor = np.array([field.factor for field in fields])
        self._offset = np.array([field.offset for field in fields])
        self._steps = 10.0 ** np.array([field.decimals for field in fields])
        limits = np.sort([self._written(robot.command_low), self._written(robot.command_high)], axis=0)
        self._lowest = np.ceil(limits[0] * self._steps - 1e-6)
        self._highest = np.floor(limits[1] * self._steps + 1e-6)
        for column, low, high in zip(robot.command_columns, self._lowest, self._highest, strict=True):
            if low > high:
                raise UserError(f"robot {robot.name!r}: link.fields.{column} is too coarse: give more decimals")
        span = robot.command_high - robot.command_low
        if np.any(np.abs(self.as_sent(robot.command_at_rest) - robot.command_at_rest) > 1e-6 * span):
            raise UserError(f"robot {robot.name!r}: link.fields cannot say 'stand still' exactly: give more decimals")
        self.topic_filter = self._link.command_topic.replace("{vehicle}", "+")
        self.announce_topic = self._link.announce_topic

    @property
    def is_for_the_group(self) -> bool:
        """Whether one message holds the commands of several vehicles."""
        return "{vehicle}" not in self._link.command_topic

    def as_sent(self, command: np.ndarray) -> np.ndarray:
        """Return what is left of commands (..., m) when they are written with the fields' decimals: within limits."""
        counts = self._counts(np.asarray(command, float))
        return (counts / self._steps - self._offset) / self._factor

    def messages(self, commands: Mapping[str, np.ndarray]) -> dict[str, bytes]:
        """Return the payload for each topic that brings each vehicle named its command (m,).

        Raises:
            ValueError: a command is not finite, beyond the robot's limits or of another length.
            UserError: a vehicle's id cannot be part of a topic.
        """
        objects = {vehicle: self._object(vehicle, command) for vehicle, command in commands.items()}
        if self.is_for_the_group:
            return {self._link.command_topic: _json(objects)} if objects else {}
        return {self._topic(vehicle): _json(content) for vehicle, content in objects.items()}

    def commands(self, topic: str, payload: bytes) -> dict[str, np.ndarray]:
        """Return the commands (m,) by vehicle that a message holds, whoever wrote it, within limits or not.

        Raises:
            ValueError: it is no such message.
        """
        content = json.loads(payload)
        if self.is_for_the_group:
            if topic != self._link.command_topic or not isinstance(content, dict):
                raise ValueError(f"not a message of commands on {self._link.command_topic}")
            return {vehicle: self._command(one) for vehicle, one in content.items()}
        before, after = self._link.command_topic.split("{vehicle}")
        vehicle = topic.removeprefix(before).removesuffix(after)
        if self._topic(vehicle) != topic:
            raise ValueError(f"not a topic of commands: {topic}")
        return {vehicle: self._command(content)}

    def _written(self, command: np.ndarray) -> np.ndarray:
        return self._factor * command + self._offset

    def _counts(self, command: np.ndarray) -> np.ndarray:
        """Return commands (..., m) in units of the last decimal that is sent."""
        return np.clip(np.round(self._written(command) * self._steps), self._lowest, self._highest)

    def _object(self, vehicle: str, command: np.ndarray) -> dict[str, float]:
        command = np.asarray(command, float)
        low, high = self.robot.command_low, self.robot.command_high
        tolerance = 1e-9 * (high - low)
        if command.shape != low.shape:
            raise ValueError(f"vehicle {vehicle!r}: a command has shape {low.shape}, not {command.shape}")
        if not np.all((command >= low - tolerance) & (command <= high + tolerance)):  # NaN is not within, either
            given, lowest, highest = command.tolist(), low.tolist(), high.tolist()
            raise ValueError(f"vehicle {vehicle!r}: command {given} is not within {lowest} and {highest}")
        numbers = self._counts(command) / self._steps + 0.0
        return {
            field.key: round(number, field.decimals) if field.decimals else int(number)
            for field, number in zip(self._link.fields.values(), numbers.tolist(), strict=True)
        }

    def _command(self, content: Any) -> np.ndarray:
        if not isinstance(content, dict):
            raise ValueError("a vehicle's command is no object")
        numbers = [content.get(field.key) for field in self._link.fields.values()]
        if not all(isinstance(number, int | float) for number in numbers):
            raise ValueError("a command lacks a number")
        return (np.array(numbers, float) - self._offset) / self._factor

    def _topic(self, vehicle: str) -> str:
        if not vehicle or set(vehicle) & set("/+#\0"):
            raise UserError(f"vehicle {vehicle!r} cannot stand in a topic: give it an id without /, + and #")
        return self._link.command_topic.replace("{vehicle}", vehicle)


def _json(content: Mapping[str, Any]) -> bytes:
    return json.dumps(content, separators=(",", ":")).encode()
