"""FC-NN with its defects repaired: no output can die, and headings do not jump."""

from typing import ClassVar, Literal

from torch import nn

from swarmtwin.dynamics.layers import normalised_layers
from swarmtwin.dynamics.model_config import ModelConfig, Steps
from swarmtwin.learning.encoding import ScalingMethod
from swarmtwin.robot import Positive, Robot


class Config(ModelConfig):
    """`conf/model/fcnn_repaired.yaml`: the layers of `fcnn`, 126,019 parameters for the MGR, with a linear output.

    The published output is a ReLU on displacements scaled to 0…1, which can fall to 0 for every input and then learns
    no more. Here inputs and outputs are standardised, the output is linear, and a heading, where a robot's models are
    given the pose, is its cosine and sine rather than one number that jumps at ±π.
    """

    scaling: ClassVar[ScalingMethod] = "standard"

    name: Literal["fcnn_repaired"] = "fcnn_repaired"
    learning_rate: Positive = 0.01
    steps: Steps = 1000

    def build(self, robot: Robot, inputs: int) -> nn.Module:
        """Build FC-NN without its last ReLU."""
        return nn.Sequential(normalised_layers((inputs, 320, 256, 128, 64), nn.Sigmoid), nn.Linear(64, 3))
