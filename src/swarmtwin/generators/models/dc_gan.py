"""DC-GAN: a deep convolutional generative adversarial network (Radford, Metz and Chintala 2015, arXiv:1511.06434).

Deconvolutions in the generator and strided convolutions in the discriminator, batch normalisation in both, no hidden
layer that is fully connected. Brought to transitions, the pixels are a row's columns in their order, so convolutions
run over one dimension, are fewer and have fewer channels, and the row is filled up to a length that can be halved.
Validation runs chose what else differs from the publication: three steps of the discriminator for each of the
generator's, no averaging of gradients (there 0.5), and a learning rate that starts higher and falls to zero.
"""

from typing import Annotated, ClassVar, Literal

from pydantic import Field
from torch import nn

from swarmtwin.generators.generator import Steps
from swarmtwin.generators.row_convolutions import Convolutions, Deconvolutions, smallest_length, start_small
from swarmtwin.generators.row_gan import Networks, NormalNoise, RowGanConfig
from swarmtwin.robot import Positive


class Config(RowGanConfig):
    """`conf/generator/dc_gan.yaml`.

    Attributes:
        noise_columns: how many random numbers a row is made of.
        channels: of the generator's deconvolutions, the widest first; of the discriminator's in reverse.
    """

    judged_apart: ClassVar[bool] = True
    name: Literal["dc_gan"] = "dc_gan"
    noise_columns: Steps = 16
    channels: Annotated[tuple[Steps, ...], Field(min_length=1)] = (64, 32)
    learning_rate: Positive = 1e-3
    decay_from: Annotated[float, Field(ge=0, le=1)] = 0.5
    beta1: Annotated[float, Field(ge=0, lt=1)] = 0.0
    batch_size: Annotated[int, Field(ge=4)] = 256
    discriminator_steps: Steps = 3
    steps: Steps = 2500

    def networks(self, width: int) -> Networks:
        """Return noise projected to channels and deconvolved, and convolutions scored by one layer."""
        deconvolutions = Deconvolutions(self.channels, width)
        features = self.channels[0] * smallest_length(self.channels, width)
        return Networks(
            NormalNoise(self.noise_columns),
            start_small(nn.Sequential(nn.Linear(self.noise_columns, features), deconvolutions)),
            start_small(
                nn.Sequential(Convolutions(self.channels[::-1], width, "stride"), nn.Linear(features, 1), nn.Sigmoid())
            ),
        )
