"""The published generative adversarial network (section 3.2 of the paper, equation 2; sizes from the authors' code)."""

from typing import Annotated, Literal

from pydantic import Field
from torch import nn

from swarmtwin.generators.generator import Steps
from swarmtwin.generators.row_gan import Networks, NormalNoise, RowGanConfig, perceptron
from swarmtwin.robot import Positive


class Config(RowGanConfig):
    """`conf/generator/gan.yaml`.

    As the authors published it, in width and depth, loss and optimiser; only the number of columns follows the robot.
    Nothing keeps the noise from collapsing.

    Attributes:
        noise_columns: how many random numbers a row is made of.
        noise_sd: their standard deviation.
        generator_layers: widths of the generator's hidden layers.
        discriminator_layers: likewise of the discriminator's.
    """

    name: Literal["gan"] = "gan"
    noise_columns: Steps = 6
    noise_sd: Positive = 0.2
    generator_layers: tuple[Steps, ...] = (32, 16, 8)
    discriminator_layers: tuple[Steps, ...] = (32, 16, 8, 6)
    headings: Literal["angle", "direction"] = "angle"
    beta1: Annotated[float, Field(ge=0, lt=1)] = 0.4
    batch_size: Annotated[int, Field(ge=4)] = 64
    discriminator_steps: Steps = 3

    def networks(self, width: int) -> Networks:
        """Return two perceptrons."""
        return Networks(
            NormalNoise(self.noise_columns, self.noise_sd),
            nn.Sequential(*perceptron((self.noise_columns, *self.generator_layers, width)), nn.Tanh()),
            nn.Sequential(*perceptron((width, *self.discriminator_layers, 1)), nn.Sigmoid()),
        )
