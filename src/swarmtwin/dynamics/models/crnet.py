"""CR-Net, the paper's convolutional-recurrent network (section 3.6, figure 4), as its authors published it."""

from itertools import pairwise
from typing import Annotated, ClassVar, Literal

from pydantic import Field
from torch import Tensor, nn

from swarmtwin.dynamics.layers import PointwiseConvolution
from swarmtwin.dynamics.model_config import ModelConfig, Steps
from swarmtwin.learning.encoding import ScalingMethod
from swarmtwin.robot import Positive, Robot

CHANNELS = 64
HIDDEN = 5
WIDTHS = (CHANNELS * HIDDEN, 128, 64, 256, 16, 256, 64, 32)
NORMALISED_LAYERS = 5


class CRNet(nn.Module):
    """Two convolutions over the input as a sequence → LSTM over their channels → fully connected layers with skips.

    95,511 parameters for the MGR (the paper says 37,211 and 85,511). Where the published facts are silent, the layers
    after the fifth are plain Tanh, and a skip is added after the activation.
    """

    def __init__(self, inputs: int, dropout: float) -> None:
        super().__init__()
        self.convolutions = nn.Sequential(PointwiseConvolution(1, 8), PointwiseConvolution(8, CHANNELS))
        self.lstm = nn.LSTM(inputs + 4, HIDDEN)
        self.layers = nn.ModuleList(
            _tanh_layer(*widths, dropout if number < NORMALISED_LAYERS else None)
            for number, widths in enumerate(pairwise(WIDTHS))
        )
        self.output = nn.Sequential(nn.Linear(WIDTHS[-1], 3), nn.Sigmoid())

    def forward(self, values: Tensor) -> Tensor:
        """Map inputs scaled to 0…1 (N, inputs) to displacements scaled to 0…1 (N, 3)."""
        channels = self.convolutions(values[None])
        sequence, _ = self.lstm(channels)
        first, second, third, fourth, fifth, sixth, seventh = self.layers
        at_second = second(first(sequence.transpose(0, 1).flatten(1)))
        at_third = third(at_second)
        at_fifth = fifth(fourth(at_third)) + at_third
        at_sixth = sixth(at_fifth) + at_second
        scaled: Tensor = self.output(seventh(at_sixth))
        return scaled


def _tanh_layer(inputs: int, outputs: int, dropout: float | None) -> nn.Sequential:
    linear = nn.Linear(inputs, outputs)
    if dropout is None:
        return nn.Sequential(linear, nn.Tanh())
    return nn.Sequential(linear, nn.BatchNorm1d(outputs), nn.Tanh(), nn.Dropout(dropout))


class Config(ModelConfig):
    """`conf/model/crnet.yaml`."""

    scaling: ClassVar[ScalingMethod] = "unit_range"

    name: Literal["crnet"] = "crnet"
    learning_rate: Positive = 0.01
    steps: Steps = 1000
    dropout: Annotated[float, Field(ge=0, lt=1)] = 0.1

    def build(self, robot: Robot, inputs: int) -> nn.Module:
        """Build CR-Net."""
        return CRNet(inputs, self.dropout)
