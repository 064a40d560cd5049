"""Cycle-GAN: two generators and two discriminators, held together by cycles (Zhu et al. 2017, arXiv:1703.10593).

Cycle-GAN translates between two domains of which no pairs are known. Here the first domain is normal noise, as many
columns as a row has, and the second the recorded transitions: one generator makes a transition of noise, the other
noise of a transition, a discriminator judges each, and whoever goes there and back must arrive where it began (mean
absolute difference). So the generator can neither leave transitions out nor make one of different noise. To draw, noise
is translated. Least-squares losses as published; perceptrons instead of residual convolutions, and no memory of rows
generated before, and a cycle weighs 1 instead of 10, which was for pictures. The learning rate falls to zero in the
second half, as published.
"""

from typing import Annotated, Literal

import torch
from pydantic import Field
from torch import Tensor, nn
from torch.nn.functional import l1_loss

from swarmtwin.generators.adversarial import LEAST_SQUARES, RealBatches, judge
from swarmtwin.generators.columns import Columns
from swarmtwin.generators.generator import Steps
from swarmtwin.generators.row_gan import Networks, NormalNoise, RowGan, RowGanConfig, perceptron
from swarmtwin.robot import Positive


class CycleGan(RowGan):
    """Noise → rows and back.

    Attributes:
        back: the generator that makes noise of rows.
        noise_discriminator: tells what it made from noise.
    """

    loss = LEAST_SQUARES
    config: "Config"

    def __init__(self, columns: Columns, config: "Config") -> None:
        super().__init__(columns, config)
        width = len(self.low)
        self.back = nn.Sequential(*perceptron((width, *config.generator_layers, width), 0.2))
        self.noise_discriminator = nn.Sequential(*perceptron((width, *config.discriminator_layers, 1), 0.2))

    def players(self) -> tuple[list[nn.Parameter], list[nn.Parameter]]:
        """Return the parameters of both generators, and of both discriminators."""
        generating = [*self.generator.parameters(), *self.back.parameters()]
        return generating, [*self.discriminator.parameters(), *self.noise_discriminator.parameters()]

    def discriminator_loss(self, real: RealBatches) -> Tensor:
        """Return the sum of both discriminators' losses."""
        rows, noise = real.draw(), self._noise(real.size)
        with torch.no_grad():
            made_rows, made_noise = self.generator(noise), self.back(rows)
        judged = judge(self.discriminator, rows, made_rows, self.judged_apart)
        noise_judged = judge(self.noise_discriminator, noise, made_noise, self.judged_apart)
        return self.loss.discriminator(*judged) + self.loss.discriminator(*noise_judged)

    def generator_loss(self, real: RealBatches) -> Tensor:
        """Return the sum of both generators' losses and of the weighted cycles."""
        rows, noise = real.draw(), self._noise(real.size)
        made_rows, made_noise = self.generator(noise), self.back(rows)
        adversarial = self.loss.generator(self.discriminator(made_rows))
        adversarial += self.loss.generator(self.noise_discriminator(made_noise))
        cycles = l1_loss(self.back(made_rows), noise) + l1_loss(self.generator(made_noise), rows)
        return adversarial + self.config.cycle_weight * cycles

    def _noise(self, count: int) -> Tensor:
        noise: Tensor = self.noise(count, self.low.device, None)
        return noise


class Config(RowGanConfig):
    """`conf/generator/cycle_gan.yaml`.

    Attributes:
        generator_layers: widths of both generators' hidden layers.
        discriminator_layers: likewise of both discriminators'.
        cycle_weight: of the cycles beside the discriminators' verdicts.
    """

    name: Literal["cycle_gan"] = "cycle_gan"
    generator_layers: tuple[Steps, ...] = (96, 96)
    discriminator_layers: tuple[Steps, ...] = (128, 128)
    cycle_weight: Positive = 1.0
    learning_rate: Positive = 1e-3
    decay_from: Annotated[float, Field(ge=0, le=1)] = 0.5
    batch_size: Annotated[int, Field(ge=4)] = 256
    steps: Steps = 8000

    def networks(self, width: int) -> Networks:
        """Return noise as wide as a row, and the perceptrons that make and judge rows."""
        return Networks(
            NormalNoise(width),
            nn.Sequential(*perceptron((width, *self.generator_layers, width), 0.2), nn.Tanh()),
            nn.Sequential(*perceptron((width, *self.discriminator_layers, 1), 0.2)),
        )

    def build(self, columns: Columns) -> CycleGan:
        """Build it."""
        return CycleGan(columns, self)
