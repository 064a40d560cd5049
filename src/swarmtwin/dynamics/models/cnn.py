"""CNN, the paper's convolutional baseline (section 4.3), as its authors published it."""

from typing import ClassVar, Literal

from torch import Tensor, nn

from swarmtwin.dynamics.layers import PointwiseConvolution
from swarmtwin.dynamics.model_config import ModelConfig, Steps
from swarmtwin.learning.encoding import ScalingMethod
from swarmtwin.robot import Positive, Robot


class CNN(nn.Module):
    """Four convolutions over the input as a sequence → 120-84-3; 59,275 parameters for the MGR (the paper: 89,275).

    The published facts leave the last layers' activations open: LeakyReLU as in the convolutions, Sigmoid at the end.
    """

    def __init__(self, inputs: int) -> None:
        super().__init__()
        self.convolutions = nn.Sequential(
            PointwiseConvolution(1, 8),
            PointwiseConvolution(8, 64),
            PointwiseConvolution(64, 96),
            PointwiseConvolution(96, 32),
        )
        length = inputs + 4 * 2  # each convolution pads by one at both ends
        self.layers = nn.Sequential(
            nn.Linear(32 * length, 120),
            nn.LeakyReLU(),
            nn.Linear(120, 84),
            nn.LeakyReLU(),
            nn.Linear(84, 3),
            nn.Sigmoid(),
        )

    def forward(self, values: Tensor) -> Tensor:
        """Map inputs scaled to 0…1 (N, inputs) to displacements scaled to 0…1 (N, 3)."""
        channels = self.convolutions(values[None])
        scaled: Tensor = self.layers(channels.transpose(0, 1).flatten(1))
        return scaled


class Config(ModelConfig):
    """`conf/model/cnn.yaml`."""

    scaling: ClassVar[ScalingMethod] = "unit_range"

    name: Literal["cnn"] = "cnn"
    learning_rate: Positive = 0.01
    steps: Steps = 1000

    def build(self, robot: Robot, inputs: int) -> nn.Module:
        """Build the CNN."""
        return CNN(inputs)
