"""A plain, well-tuned multi-layer perceptron: the baseline that the paper's comparison lacks."""

from itertools import pairwise
from typing import Annotated, ClassVar, Literal

from pydantic import Field
from torch import nn

from swarmtwin.dynamics.model_config import ModelConfig
from swarmtwin.dynamics.scaling import ScalingMethod
from swarmtwin.robot import Robot


class Config(ModelConfig):
    """`conf/model/mlp.yaml`: standardised inputs and outputs, headings as cosine and sine, ReLU in between."""

    scaling: ClassVar[ScalingMethod] = "standard"

    name: Literal["mlp"] = "mlp"
    learning_rate: float = 0.01
    steps: int = 1000
    layers: Annotated[tuple[int, ...], Field(min_length=1)] = (128, 128)

    def build(self, robot: Robot, inputs: int) -> nn.Module:
        """Build the perceptron."""
        stack: list[nn.Module] = []
        for pair in pairwise((inputs, *self.layers)):
            stack += [nn.Linear(*pair), nn.ReLU()]
        return nn.Sequential(*stack, nn.Linear(self.layers[-1], 3))
