"""CR-Net, the paper's convolutional-recurrent network (section 3.6, figure 4), as its authors published it."""

from typing import Annotated, ClassVar, Literal

from pydantic import Field
from torch import Tensor, nn

from swarmtwin.dynamics.layers import PointwiseConvolution
from swarmtwin.dynamics.model_config import ModelConfig, Steps
from swarmtwin.learning.encoding import ScalingMethod
from swarmtwin.robot import Positive, Robot


class CRNet(nn.Module):
    """Two convolutions over the input as a sequence → LSTM over their channels → fully connected layers with skips.

    95,511 parameters for the MGR (the paper says 37,211 and 85,511). Where the published facts are silent, the layers
    after the fifth are plain Tanh, and a skip is added after the activation.
    """

    def __init__(self, inputs: int, dropout: float) -> None:
        super().__init__()
        self.convolutions = nn.Sequential(PointwiseConvolution(1, 8), PointwiseConvolution(8, 64))
        self.lstm = nn.LSTM(inputs + 4, 5)
        self.layers = nn.ModuleList(
            [
                _normalised_layer(64 * 5, 128, dropout),
                _normalised_layer(128, 64, dropout),
                _normalised_layer(64, 256, dropout),
                _normalised_layer(256, 16, dropout),
                _normalised_layer(16, 256, dropout),
                nn.Sequential(nn.Linear(256, 64), nn.Tanh()),
                nn.Sequential(nn.Linear(64, 32), nn.Tanh()),
            ]
        )
        self.output = nn.Sequential(nn.Linear(32, 3), nn.Sigmoid())

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


def _normalised_layer(inputs: int, outputs: int, dropout: float) -> nn.Sequential:
    return nn.Sequential(nn.Linear(inputs, outputs), nn.BatchNorm1d(outputs), nn.Tanh(), nn.Dropout(dropout))


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
