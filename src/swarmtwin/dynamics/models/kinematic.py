"""The robot's kinematic model: a few physical, named parameters, fitted to the training data like any network."""

from collections.abc import Sequence
from typing import ClassVar, Literal, Self

import torch
from pydantic import model_validator
from torch import Tensor, nn

from swarmtwin.dynamics.model_config import ModelConfig, Steps
from swarmtwin.errors import UserError
from swarmtwin.geometry import integrate_twist
from swarmtwin.kinematics import Before
from swarmtwin.learning.encoding import ScalingMethod
from swarmtwin.robot import Positive, Robot, SituationPart


class KinematicModel(nn.Module):
    """Situations in physical units → displacements (N, 3), by the equations that the robot's file names.

    Columns: command, (N, m), and where the motion has momentum velocity, (N, m + 3), or previous command and velocity,
    (N, 2 m + 3). Without the previous command, the present one is taken to have been held before.

    A positive parameter is learned as the logarithm of its ratio to its size, a signed one as its ratio.
    """

    def __init__(self, robot: Robot, situation: Sequence[SituationPart] = ("command",)) -> None:
        """Start at the parameters' sizes.

        Raises:
            UserError: the robot has no equations, or these know no momentum and are given a velocity.
        """
        super().__init__()
        self.robot = robot
        self.equations = robot.kinematic_equations()
        self.parameters_by_name = dict(self.equations.parameters(robot))
        self.has_momentum = "velocity" in situation
        momentum = self.equations.momentum_parameters(robot)
        if self.has_momentum and not momentum:
            raise UserError(f"kinematics {robot.kinematics!r} know no momentum: set model.situation=[command]")
        if self.has_momentum:
            self.parameters_by_name |= momentum
        self.free = nn.ParameterDict({name: nn.Parameter(torch.zeros(())) for name in self.parameters_by_name})

    def value(self, name: str) -> Tensor:
        """Return a parameter in its unit, a scalar."""
        parameter = self.parameters_by_name[name]
        free: Tensor = self.free[name]
        return parameter.size * (free if parameter.signed else free.exp())

    def physical_parameters(self) -> dict[str, float]:
        """Return all parameters by name; the unit is in the name."""
        return {name: self.value(name).item() for name in self.parameters_by_name}

    def forward(self, situation: Tensor) -> Tensor:
        """Predict displacements (N, 3) from the columns of situations, in the order above."""
        values = {name: self.value(name) for name in self.parameters_by_name}
        columns = len(self.robot.command)
        command = situation[:, :columns]
        if self.has_momentum:
            command_before = situation[:, columns:-3] if situation.shape[1] > columns + 3 else command
            before = Before(command_before, situation[:, -3:])
            velocities = self.equations.velocities_after(before, command, values, self.robot)
        else:
            velocities = self.equations.velocities(command, values, self.robot)
        return integrate_twist(torch.stack(velocities, dim=-1), self.robot.period_s)


class Config(ModelConfig):
    """`conf/model/kinematic.yaml`.

    Attributes:
        situation: the command; for momentum, the velocity as well, better with the previous command: what the throttle
            asked for in the period before tells how the speed changed over it. Null: all three where the robot's models
            are given its velocity and its equations know momentum.
    """

    scaling: ClassVar[ScalingMethod] = "physical"

    name: Literal["kinematic"] = "kinematic"
    learning_rate: Positive = 0.03
    steps: Steps = 500
    situation: tuple[Literal["command", "previous_command", "velocity"], ...] | None = ("command",)

    @model_validator(mode="after")
    def _known_situation(self) -> Self:
        if self.situation and "previous_command" in self.situation and "velocity" not in self.situation:
            raise ValueError("kinematics look at previous_command beside velocity alone: add velocity, or take it out")
        return self

    def inputs(self, robot: Robot) -> tuple[SituationPart, ...]:
        """Return the parts of a situation that the model looks at."""
        if self.situation:
            return self.situation
        has_momentum = "velocity" in robot.situation and robot.kinematic_equations().momentum_parameters(robot)
        return ("command", "previous_command", "velocity") if has_momentum else ("command",)

    def build(self, robot: Robot, inputs: int) -> nn.Module:
        """Build the kinematic model that the robot's file names."""
        return KinematicModel(robot, self.inputs(robot))
