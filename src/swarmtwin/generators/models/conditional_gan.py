"""Conditional GAN (Mirza and Osindero 2014, arXiv:1411.1784): a situation is drawn, and a displacement made for it.

Generator and discriminator are both given the situation, beside noise or displacement. A diffusion model draws the
situations, the same as residual diffusion has. The optimiser is Adam; validation runs chose three steps of the
discriminator for each of the generator's, no averaging of gradients, and a learning rate that falls to zero.
"""

from typing import Annotated, Any, Literal

import torch
from pydantic import Field
from torch import Tensor, nn

from swarmtwin.generators.adversarial import (
    AdversarialConfig,
    AdversarialGenerator,
    AdversarialTraining,
    RealBatches,
    normal,
    scaled_to_range,
)
from swarmtwin.generators.columns import Columns
from swarmtwin.generators.conditional import ConditionalGenerator
from swarmtwin.generators.denoiser import Denoiser
from swarmtwin.generators.generator import Count, Generator, RealRows, Steps
from swarmtwin.generators.row_gan import perceptron
from swarmtwin.learning.recipe import OneCycle
from swarmtwin.robot import Positive


class ConditionalGan(ConditionalGenerator, AdversarialGenerator):
    """Noise and a situation → the displacement, scaled to −1…1; the discriminator sees situation and displacement."""

    config: "Config"
    low: Tensor
    high: Tensor

    def __init__(self, columns: Columns, config: "Config") -> None:
        super().__init__(columns, config, config)
        self.judged_apart = False
        given, made = self.encoding.width + config.noise_columns, self.encoding.width + 3
        self.generator = nn.Sequential(*perceptron((given, *config.generator_layers, 3), 0.2), nn.Tanh())
        self.discriminator = nn.Sequential(*perceptron((made, *config.discriminator_layers, 1), 0.2), nn.Sigmoid())
        self.situations = Denoiser(columns.situation_width, 0, config.situation_width)
        self.register_buffer("low", torch.zeros(3))
        self.register_buffer("high", torch.ones(3))

    def players(self) -> tuple[list[nn.Parameter], list[nn.Parameter]]:
        """Return the parameters of the two networks; what draws situations learns apart."""
        return [*self.generator.parameters()], [*self.discriminator.parameters()]

    def displacements(self, inputs: Tensor, rng: torch.Generator) -> Tensor:
        """Generate displacements."""
        return torch.lerp(self.low, self.high, (self._made(inputs, rng) + 1) / 2)

    def generated(self, real: RealBatches) -> Tensor:
        """Return real situations, each with a generated displacement."""
        inputs = real.draw()[:, :-3]
        return torch.cat([inputs, self._made(inputs, None)], dim=1)

    def learn_scaling(self, rows: Tensor) -> None:
        """Take the situations' distributions and the displacements' ranges."""
        self.marginals.learn(rows[:, :-3])
        self.low.copy_(rows[:, -3:].min(dim=0).values)
        self.high.copy_(rows[:, -3:].max(dim=0).values)

    def scaled(self, rows: Tensor) -> Tensor:
        """Return the situation as the networks see it, and the displacement scaled."""
        return torch.cat([self.inputs(rows[:, :-3]), scaled_to_range(rows[:, -3:], self.low, self.high)], dim=1)

    def _made(self, inputs: Tensor, rng: torch.Generator | None) -> Tensor:
        noise = normal(len(inputs), self.config.noise_columns, inputs.device, rng)
        made: Tensor = self.generator(torch.cat([inputs, noise], dim=1))
        return made


class ConditionalGanTraining(AdversarialTraining):
    """The two players, and beside them, at the same steps, the diffusion model of situations."""

    generator: ConditionalGan
    scores: Tensor

    def __init__(self, generator: ConditionalGan, real: RealRows) -> None:
        super().__init__(generator, real)
        self.register_buffer("scores", generator.marginals.scores(real.train[:, :-3]))

    def configure_optimizers(self) -> Any:
        """Adam for each of the players, and for the situations."""
        situations = torch.optim.Adam(self.generator.situations.parameters(), fused=True)
        return [*super().configure_optimizers(), situations]

    def training_step(self, step: int, batch_index: int) -> dict[str, Tensor]:
        """Let the players learn, and then what draws situations, as long as it has steps of its own."""
        losses = super().training_step(step, batch_index)
        config = self.generator.config
        if step >= config.situation_steps:
            return losses
        scores = self.scores[torch.randint(len(self.scores), (config.situation_batch_size,), device=self.device)]
        loss = self.generator.situations.loss(scores, scores[:, :0])
        learning_rate = config.situation_learning_rate * OneCycle().share(step, config.situation_steps)
        self.descend(loss, 2, learning_rate)
        return {**losses, "situation_loss": loss.detach()}


class Config(AdversarialConfig):
    """`conf/generator/conditional_gan.yaml`.

    Attributes:
        noise_columns: how many random numbers a displacement is made of.
        generator_layers: widths of the generator's hidden layers.
        discriminator_layers: likewise of the discriminator's.
        situation_width: of the diffusion model of situations.
        situation_steps: of its training; no more than `steps` count.
        situation_learning_rate: its largest.
        situation_batch_size: situations a step of it.
        wall_reaches: where motion depends on the pose: how far walls are looked for, in the arena's shorter sides.
        place_weight: of position and heading themselves, beside the walls.
        quantiles: that each column of the situation is kept as.
        sampling_steps: of drawing situations, from noise to data.
    """

    name: Literal["conditional_gan"] = "conditional_gan"
    noise_columns: Steps = 8
    generator_layers: tuple[Steps, ...] = (64, 64)
    discriminator_layers: tuple[Steps, ...] = (128, 128)
    situation_width: Steps = 96
    situation_steps: Steps = 1500
    situation_learning_rate: Positive = 0.005
    situation_batch_size: Steps = 512
    wall_reaches: tuple[Positive, ...] = (0.125, 0.03125)
    place_weight: Annotated[float, Field(ge=0)] = 0.2
    quantiles: Count = 129
    sampling_steps: Count = 12
    learning_rate: Positive = 1e-3
    decay_from: Annotated[float, Field(ge=0, le=1)] = 0.5
    beta1: Annotated[float, Field(ge=0, lt=1)] = 0.0
    batch_size: Annotated[int, Field(ge=4)] = 256
    discriminator_steps: Steps = 3
    steps: Steps = 6000

    def build(self, columns: Columns) -> ConditionalGan:
        """Build it."""
        return ConditionalGan(columns, self)

    def training(self, generator: Generator, real: RealRows) -> ConditionalGanTraining:
        """Return its training."""
        assert isinstance(generator, ConditionalGan)
        return ConditionalGanTraining(generator, real)
