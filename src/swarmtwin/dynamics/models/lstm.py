"""LSTM, the paper's recurrent baseline (section 4.3): one layer over the input, then a small BatchNorm MLP."""

from typing import ClassVar, Literal

from torch import nn

from swarmtwin.dynamics.layers import RecurrentNetwork
from swarmtwin.dynamics.model_config import ModelConfig, Steps, Width, Widths
from swarmtwin.learning.encoding import ScalingMethod
from swarmtwin.robot import Positive, Robot


class Config(ModelConfig):
    """`conf/model/lstm.yaml`.

    The published sizes do not give the 73,879 parameters that the paper states. Ours are chosen near it: hidden size
    96 and layers of 160 and 64, 64,483 parameters for every robot, since only the last hidden state goes on.
    """

    scaling: ClassVar[ScalingMethod] = "unit_range"

    name: Literal["lstm"] = "lstm"
    learning_rate: Positive = 0.01
    steps: Steps = 1000
    hidden: Width = 96
    layers: Widths = (160, 64)

    def build(self, robot: Robot, inputs: int) -> nn.Module:
        """Build the LSTM."""
        return RecurrentNetwork(nn.LSTM(1, self.hidden), self.layers)
