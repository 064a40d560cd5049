"""GRU, the paper's second recurrent baseline (section 4.3): one layer over the input, then a small BatchNorm MLP."""

from typing import ClassVar, Literal

from torch import nn

from swarmtwin.dynamics.layers import RecurrentNetwork
from swarmtwin.dynamics.model_config import ModelConfig, Steps, Width, Widths
from swarmtwin.learning.encoding import ScalingMethod
from swarmtwin.robot import Positive, Robot


class Config(ModelConfig):
    """`conf/model/gru.yaml`.

    The published sizes do not give the 73,626 parameters that the paper states, and a GRU of hidden size 1 cannot
    carry both position and angle. Ours has the LSTM's sizes: 54,979 parameters for every robot.
    """

    scaling: ClassVar[ScalingMethod] = "unit_range"

    name: Literal["gru"] = "gru"
    learning_rate: Positive = 0.01
    steps: Steps = 1000
    hidden: Width = 96
    layers: Widths = (160, 64)

    def build(self, robot: Robot, inputs: int) -> nn.Module:
        """Build the GRU."""
        return RecurrentNetwork(nn.GRU(1, self.hidden), self.layers)
