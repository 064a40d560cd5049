"""FC-NN, the paper's fully connected baseline (section 4.3), as its authors published it."""

from typing import ClassVar, Literal

from torch import nn

from swarmtwin.dynamics.layers import normalised_layers
from swarmtwin.dynamics.model_config import ModelConfig, Steps
from swarmtwin.learning.encoding import ScalingMethod
from swarmtwin.robot import Positive, Robot


class Config(ModelConfig):
    """`conf/model/fcnn.yaml`: n-320-256-128-64-3 with BatchNorm and Sigmoid, 126,019 parameters for the MGR.

    The published output is a ReLU on displacements scaled to 0…1. It can fall to 0 for every input and then learns no
    more; `training.train` flags such a seed.
    """

    scaling: ClassVar[ScalingMethod] = "unit_range"

    name: Literal["fcnn"] = "fcnn"
    learning_rate: Positive = 0.01
    steps: Steps = 1000

    def build(self, robot: Robot, inputs: int) -> nn.Module:
        """Build FC-NN."""
        hidden = normalised_layers((inputs, 320, 256, 128, 64), nn.Sigmoid)
        return nn.Sequential(hidden, nn.Linear(64, 3), nn.ReLU())
