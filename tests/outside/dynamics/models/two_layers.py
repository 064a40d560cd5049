"""The smallest network that is not linear."""

from typing import ClassVar, Literal

from torch import nn

from swarmtwin.dynamics.model_config import ModelConfig, Steps, Width
from swarmtwin.learning.encoding import ScalingMethod
from swarmtwin.robot import Positive


class Config(ModelConfig):
    """`conf/model/two_layers.yaml`."""

    scaling: ClassVar[ScalingMethod] = "standard"

    name: Literal["two_layers"] = "two_layers"
    learning_rate: Positive = 0.02
    steps: Steps = 200
    width: Width = 32

    def build(self, robot, inputs):
        return nn.Sequential(nn.Linear(inputs, self.width), nn.Tanh(), nn.Linear(self.width, 3))
