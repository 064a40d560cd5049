"""CNN with its defects repaired: its convolutions see neighbouring inputs, and headings do not jump."""

from itertools import pairwise
from typing import ClassVar, Literal

from torch import Tensor, nn

from swarmtwin.dynamics.model_config import ModelConfig, Steps
from swarmtwin.learning.encoding import ScalingMethod
from swarmtwin.robot import Positive, Robot


class RepairedCNN(nn.Module):
    """Four convolutions of kernel 3 over the input as a sequence, each with BatchNorm and LeakyReLU → 120-84-3."""

    def __init__(self, inputs: int) -> None:
        super().__init__()
        stack: list[nn.Module] = []
        for channels_in, channels_out in pairwise((1, 8, 64, 96, 32)):
            stack += [nn.Conv1d(channels_in, channels_out, kernel_size=3, padding=1), nn.BatchNorm1d(channels_out)]
            stack.append(nn.LeakyReLU())
        self.convolutions = nn.Sequential(*stack)
        self.layers = nn.Sequential(
            nn.Linear(32 * inputs, 120), nn.LeakyReLU(), nn.Linear(120, 84), nn.LeakyReLU(), nn.Linear(84, 3)
        )

    def forward(self, values: Tensor) -> Tensor:
        """Map standardised inputs (N, inputs) to standardised displacements (N, 3)."""
        standardised: Tensor = self.layers(self.convolutions(values[:, None]).flatten(1))
        return standardised


class Config(ModelConfig):
    """`conf/model/cnn_repaired.yaml`: the channels and layers of `cnn`, 48,027 parameters for the MGR.

    The published convolutions have kernel 1: they look at one input at a time, and what they pad adds constants alone.
    Here the kernel is 3, inputs and outputs are standardised, the output is linear, and
    a heading is its cosine and sine rather than one number that jumps at ±π.
    """

    scaling: ClassVar[ScalingMethod] = "standard"

    name: Literal["cnn_repaired"] = "cnn_repaired"
    learning_rate: Positive = 0.01
    steps: Steps = 1000

    def build(self, robot: Robot, inputs: int) -> nn.Module:
        """Build the CNN with kernels of 3."""
        return RepairedCNN(inputs)
