"""The robot's kinematic model: a few physical, named parameters, fitted to the training data like any network."""

from typing import ClassVar, Literal

import torch
from torch import Tensor, nn

from swarmtwin.dynamics.model_config import ModelConfig, Steps
from swarmtwin.geometry import integrate_twist
from swarmtwin.learning.encoding import ScalingMethod
from swarmtwin.robot import Positive, Robot


class KinematicModel(nn.Module):
    """Commands in the robot's units (N, m) → displacements (N, 3), by the equations that the robot's file names.

    A positive parameter is learned as the logarithm of its ratio to its size, a signed one as its ratio.
    """

    def __init__(self, robot: Robot) -> None:
        super().__init__()
        self.robot = robot
        self.equations = robot.kinematic_equations()
        self.parameters_by_name = dict(self.equations.parameters(robot))
        self.free = nn.ParameterDict({name: nn.Parameter(torch.zeros(())) for name in self.parameters_by_name})

    def value(self, name: str) -> Tensor:
        """Return a parameter in its unit, a scalar."""
        parameter = self.parameters_by_name[name]
        free: Tensor = self.free[name]
        return parameter.size * (free if parameter.signed else free.exp())

    def physical_parameters(self) -> dict[str, float]:
        """Return all parameters by name; the unit is in the name."""
        return {name: self.value(name).item() for name in self.parameters_by_name}

    def forward(self, command: Tensor) -> Tensor:
        """Predict displacements (N, 3)."""
        values = {name: self.value(name) for name in self.parameters_by_name}
        velocities = self.equations.velocities(command, values, self.robot)
        return integrate_twist(torch.stack(velocities, dim=-1), self.robot.period_s)


class Config(ModelConfig):
    """`conf/model/kinematic.yaml`."""

    scaling: ClassVar[ScalingMethod] = "physical"

    name: Literal["kinematic"] = "kinematic"
    learning_rate: Positive = 0.03
    steps: Steps = 500
    situation: tuple[Literal["command"]] = ("command",)

    def build(self, robot: Robot, inputs: int) -> nn.Module:
        """Build the kinematic model that the robot's file names."""
        return KinematicModel(robot)
