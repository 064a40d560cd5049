"""What carries commands to the robots."""

from collections.abc import Mapping
from typing import Protocol

import numpy as np

from swarmtwin.errors import RefusedError
from swarmtwin.robot import Robot


class LinkLostError(RefusedError):
    """The link to the robots is gone; the message says to where, and why."""


class Link(Protocol):
    """A connection to the vehicles of one robot.

    Attributes:
        robot: what it speaks to.
    """

    robot: Robot

    @property
    def is_connected(self) -> bool:
        """Whether what is sent now has a way to go."""

    @property
    def announced(self) -> Mapping[str, float]:
        """Ids of vehicles that have said that they are there, and when on the monotonic clock."""

    def send(self, commands: Mapping[str, np.ndarray]) -> float:
        """Send a command (m,), in the robot's units, to each vehicle named; never waits, nothing is kept for later.

        Returns:
            when it was handed to the network, on the monotonic clock.

        Raises:
            LinkLostError: it is not connected.
            ValueError: a command is not finite or beyond the robot's limits: whoever sends bounds first.
        """

    def close(self) -> None:
        """Disconnect; twice does no harm. It does not stop the vehicles: send zeros before."""
