"""FCC-GAN: fully connected and convolutional networks (Barua, Erfani and Bailey 2019, arXiv:1905.02417).

Several fully connected layers lead from the noise to the deconvolutions of a DC-GAN, and from the discriminator's
convolutions, which are followed by average pooling, to its score. Brought to transitions as DC-GAN is, one-dimensional
over a row's columns and smaller, and trained as it is.
"""

from typing import Annotated, ClassVar, Literal

from pydantic import Field
from torch import nn

from swarmtwin.generators.generator import Steps
from swarmtwin.generators.row_convolutions import Convolutions, Deconvolutions, smallest_length
from swarmtwin.generators.row_gan import Networks, NormalNoise, RowGanConfig, perceptron
from swarmtwin.robot import Positive


class Config(RowGanConfig):
    """`conf/generator/fcc_gan.yaml`.

    Attributes:
        noise_columns: how many random numbers a row is made of.
        generator_layers: widths of the fully connected layers before the deconvolutions.
        channels: of the generator's deconvolutions, the widest first; of the discriminator's in reverse.
        discriminator_layers: widths of the fully connected layers after the convolutions.
    """

    judged_apart: ClassVar[bool] = True
    name: Literal["fcc_gan"] = "fcc_gan"
    noise_columns: Steps = 16
    generator_layers: tuple[Steps, ...] = (64, 128)
    channels: Annotated[tuple[Steps, ...], Field(min_length=1)] = (32, 16)
    discriminator_layers: tuple[Steps, ...] = (64, 16)
    learning_rate: Positive = 1e-3
    decay_from: Annotated[float, Field(ge=0, le=1)] = 0.5
    beta1: Annotated[float, Field(ge=0, lt=1)] = 0.0
    batch_size: Annotated[int, Field(ge=4)] = 256
    discriminator_steps: Steps = 3
    steps: Steps = 2500

    def networks(self, width: int) -> Networks:
        """Return fully connected layers before deconvolutions, and after convolutions."""
        features = self.channels[0] * smallest_length(self.channels, width)
        return Networks(
            NormalNoise(self.noise_columns),
            nn.Sequential(
                *perceptron((self.noise_columns, *self.generator_layers, features), 0.2),
                Deconvolutions(self.channels, width),
            ),
            nn.Sequential(
                Convolutions(self.channels[::-1], width, "pooling"),
                *perceptron((features, *self.discriminator_layers, 1), 0.2),
                nn.Sigmoid(),
            ),
        )
