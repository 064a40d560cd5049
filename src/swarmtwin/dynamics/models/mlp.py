"""A plain, well-tuned multi-layer perceptron: the baseline that the paper's comparison lacks."""

from itertools import pairwise
from typing import ClassVar, Literal

from torch import nn

from swarmtwin.dynamics.model_config import ModelConfig, Steps, Widths
from swarmtwin.learning.encoding import ScalingMethod
from swarmtwin.robot import Positive, Robot


class Config(ModelConfig):
    """`conf/model/mlp.yaml`: standardised inputs and outputs, headings as cosine and sine, ReLU in between."""

    scaling: ClassVar[ScalingMethod] = "standard"

    name: Literal["mlp"] = "mlp"
    learning_rate: Positive = 0.01
    steps: Steps = 1000
    layers: Widths = (128, 128)

    def build(self, robot: Robot, inputs: int) -> nn.Module:
        """Build the perceptron."""
        stack: list[nn.Module] = []
        for pair in pairwise((inputs, *self.layers)):
            stack += [nn.Linear(*pair), nn.ReLU()]
        return nn.Sequential(*stack, nn.Linear(self.layers[-1], 3))
