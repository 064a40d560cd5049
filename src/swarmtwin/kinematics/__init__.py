"""Kinematics: how a robot's command becomes a twist, one file each, found by the name in the robot's file.

Each file ends in the class `Equations`: the physical parameters of the motion, the equations, and what actuators
usually go with them. Fitting them is the business of `dynamics/models/kinematic.py`.
"""

from __future__ import annotations

import logging
from abc import ABC, abstractmethod
from collections.abc import Mapping
from typing import TYPE_CHECKING, Any, ClassVar, Literal, NamedTuple, Protocol

import numpy as np
from pydantic import model_validator

from swarmtwin.plugins import plugin_path
from swarmtwin.strict_model import Positive, StrictModel

if TYPE_CHECKING:
    from torch import Tensor

__path__ = plugin_path(__name__, __path__)

logger = logging.getLogger(__name__)


class Actuators(StrictModel):
    """What moves a robot, as far as a diagnosis must know it.

    Attributes:
        kind: `wheel`: speed follows the command, and what grips less goes less far; `thrust`: fins, propellers, jets
            push against a drag; `unknown`: a diagnosis leaves out the causes that lie in them.
        effort: the command columns that each say how hard one actuator works; of wheels the left and the right one, or
            the throttle of all. None where the command is a forward speed and a turn rate. Left out: as usual for the
            robot's kinematics.
        steering: the command column that is the angle of a fin or of steered wheels in degrees, if one is; of wheels,
            positive to the left.
        track_mm: of wheels, the distance between left and right; null: learned from the recording where the command
            names each wheel.
    """

    kind: Literal["wheel", "thrust", "unknown"]
    effort: tuple[str, ...] = ()
    steering: str | None = None
    track_mm: Positive | None = None

    @model_validator(mode="before")
    @classmethod
    def _without_strength_exponents(cls, content: Any) -> Any:
        """Files of earlier versions state how motion grows with an actuator's speed; it is learned now."""
        if not isinstance(content, dict) or "strength_exponents" not in content:
            return content
        if content["strength_exponents"] not in ([1.0, 1.0, 1.0], (1.0, 1.0, 1.0)):
            logger.warning(
                "actuators: strength_exponents has no effect any more, since how motion grows with an actuator's speed "
                "is learned from recordings: take the line out"
            )
        return {name: value for name, value in content.items() if name != "strength_exponents"}

    def columns(self) -> tuple[str, ...]:
        """Return the command columns that it names."""
        return (*self.effort, *([self.steering] if self.steering else []))


class DrivenRobot(Protocol):
    """What kinematics look at of a robot, whose file names them: see `swarmtwin.robot.Robot`."""

    @property
    def period_s(self) -> float:
        """Control period."""

    @property
    def vehicle_size_mm(self) -> tuple[float, float]:
        """Footprint: length, width."""

    @property
    def command_columns(self) -> tuple[str, ...]:
        """Names of the command's m columns, in order."""

    @property
    def command_high(self) -> np.ndarray:
        """Upper command limits, (m,)."""

    @property
    def displacement_limit(self) -> np.ndarray:
        """Largest believable absolute displacement over one period, (3,): mm, mm, rad."""


class PhysicalParameter(NamedTuple):
    """A parameter to be fitted: positive ones start at `size` and stay positive, signed ones start at 0.

    Attributes:
        size: its order of magnitude, in the unit that its name states.
        signed: whether it may be negative.
    """

    size: float
    signed: bool = False


class Before(NamedTuple):
    """The control period before, of N vehicles.

    Attributes:
        command: (N, m) held over it.
        velocity: (N, 3) forward_mm_s, left_mm_s, turn_rad_s, its mean.
    """

    command: Tensor
    velocity: Tensor


class KinematicEquations(ABC):
    """The kinematics of one kind of drive.

    Attributes:
        command_size: how many numbers a command has, m.
    """

    command_size: ClassVar[int]

    @classmethod
    @abstractmethod
    def usual_actuators(cls, robot: DrivenRobot) -> Actuators:
        """Return the actuators of a robot whose file states none."""

    @abstractmethod
    def parameters(self, robot: DrivenRobot) -> Mapping[str, PhysicalParameter]:
        """Return the parameters by name, with the unit in the name, sized for a robot."""

    def nominal_values(self, robot: DrivenRobot) -> Mapping[str, float]:
        """Return the parameters of a vehicle that nobody has recorded, by name: positive ones as sized, signed ones 0.

        A drive that steers by a signed one states its usual value instead.
        """
        parameters = self.parameters(robot)
        return {name: 0.0 if parameter.signed else parameter.size for name, parameter in parameters.items()}

    def momentum_parameters(self, robot: DrivenRobot) -> Mapping[str, PhysicalParameter]:
        """Return the parameters that `velocities_after` has beyond these; none: the motion has no momentum."""
        return {}

    @abstractmethod
    def velocities(
        self, command: Tensor, values: Mapping[str, Tensor], robot: DrivenRobot
    ) -> tuple[Tensor, Tensor, Tensor]:
        """Return the velocities that a command brings about.

        Args:
            command: (N, m) in the robot's units.
            values: of the parameters, scalars.
            robot: whose command it is.

        Returns:
            forward_mm_s, left_mm_s, turn_rad_s, each (N,), constant over the period.
        """

    def velocities_after(
        self,
        before: Before,
        command: Tensor,
        values: Mapping[str, Tensor],
        robot: DrivenRobot,
    ) -> tuple[Tensor, Tensor, Tensor]:
        """Return the mean velocities over a period that begins in motion, where there are `momentum_parameters`.

        Args:
            before: the motion of the period before.
            command: (N, m) in the robot's units.
            values: of all parameters, scalars.
            robot: whose command it is.

        Returns:
            forward_mm_s, left_mm_s, turn_rad_s, each (N,), those whose constant twist leads to the period's end.
        """
        return self.velocities(command, values, robot)
