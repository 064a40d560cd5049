"""Kinematics: how a robot's command becomes a twist, one file each, found by the name in the robot's file.

Each file ends in the class `Equations`: the physical parameters of the motion, the equations, and what actuators
usually go with them. Fitting them is the business of `dynamics/models/kinematic.py`.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Mapping
from typing import TYPE_CHECKING, ClassVar, NamedTuple

from swarmtwin.plugins import plugin_path

if TYPE_CHECKING:
    from torch import Tensor

    from swarmtwin.robot import Actuators, Robot

__path__ = plugin_path(__name__, __path__)


class PhysicalParameter(NamedTuple):
    """A parameter to be fitted: positive ones start at `size` and stay positive, signed ones start at 0.

    Attributes:
        size: its order of magnitude, in the unit that its name states.
        signed: whether it may be negative.
    """

    size: float
    signed: bool = False


class KinematicEquations(ABC):
    """The kinematics of one kind of drive.

    Attributes:
        command_size: how many numbers a command has, m.
    """

    command_size: ClassVar[int]

    @classmethod
    @abstractmethod
    def usual_actuators(cls, robot: Robot) -> Actuators:
        """Return the actuators of a robot whose file states none."""

    @abstractmethod
    def parameters(self, robot: Robot) -> Mapping[str, PhysicalParameter]:
        """Return the parameters by name, with the unit in the name, sized for a robot."""

    @abstractmethod
    def velocities(self, command: Tensor, values: Mapping[str, Tensor], robot: Robot) -> tuple[Tensor, Tensor, Tensor]:
        """Return the velocities that a command brings about.

        Args:
            command: (N, m) in the robot's units.
            values: of the parameters, scalars.
            robot: whose command it is.

        Returns:
            forward_mm_s, left_mm_s, turn_rad_s, each (N,), constant over the period.
        """
