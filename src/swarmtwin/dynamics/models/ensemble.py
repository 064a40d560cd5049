"""An ensemble of perceptrons: what the generator `residual_diffusion` predicts the mean with, used directly."""

from typing import Annotated, ClassVar, Literal

import torch
from pydantic import Field
from torch import Tensor, nn

from swarmtwin.dynamics.model_config import ModelConfig, Steps, Widths
from swarmtwin.learning.encoding import Encoding, ScalingMethod
from swarmtwin.learning.ensemble import Ensemble
from swarmtwin.robot import Positive, Robot


class PerceptronEnsemble(nn.Module):
    """Several perceptrons; in training each situation is answered by one of them, afterwards by the mean of all."""

    def __init__(self, inputs: int, members: int, layers: Widths) -> None:
        super().__init__()
        self.perceptrons = Ensemble(members, [range(inputs)], layers=layers, alike=False)

    def forward(self, inputs: Tensor) -> Tensor:
        """Return scaled displacements (N, 3)."""
        if not self.training:
            return self.perceptrons.mean(inputs)
        in_turn = torch.arange(len(inputs), device=inputs.device) % self.perceptrons.members
        return self.perceptrons.held_out(inputs, in_turn)


class Config(ModelConfig):
    """`conf/model/ensemble.yaml`: commands and positions by their limits, walls as the generator sees them.

    Attributes:
        members: how many perceptrons.
        layers: widths of their hidden layers.
        place_weight: of position and heading themselves, beside the walls.
    """

    scaling: ClassVar[ScalingMethod] = "standard"

    name: Literal["ensemble"] = "ensemble"
    learning_rate: Positive = 0.01
    steps: Steps = 1000
    wall_reaches: tuple[Positive, ...] = (0.125, 0.03125)
    members: Annotated[int, Field(ge=2)] = 5
    layers: Widths = (96, 96)
    place_weight: Annotated[float, Field(ge=0)] = 0.2

    def encoding(self, robot: Robot) -> Encoding:
        """Return the generator's."""
        return Encoding.by_limits(robot, self.inputs(robot), self.wall_reaches, self.place_weight)

    def build(self, robot: Robot, inputs: int) -> nn.Module:
        """Build the perceptrons."""
        return PerceptronEnsemble(inputs, self.members, self.layers)
