"""The published generative adversarial network (section 3.2 of the paper, equation 2; sizes from the authors' code)."""

from collections.abc import Sequence
from itertools import pairwise
from typing import Annotated, Any, Literal

import torch
from pydantic import Field
from torch import Tensor, nn
from torch.nn.functional import binary_cross_entropy

from swarmtwin.generators.columns import Columns
from swarmtwin.generators.generator import Generator, GeneratorConfig, GeneratorTraining, RealRows, Steps
from swarmtwin.generators.quality import mean_neighbour_distance
from swarmtwin.robot import Positive


class Gan(Generator):
    """Noise → whole rows, scaled to −1…1; the discriminator that tells them from real ones is kept with it.

    As the authors published it, in width and depth, loss and optimiser; only the number of columns follows the robot.
    Nothing ties the displacement to the command but the discriminator, and nothing keeps the noise from collapsing.
    """

    config: "Config"
    low: Tensor
    high: Tensor

    def __init__(self, columns: Columns, config: "Config") -> None:
        super().__init__(columns, config)
        width = columns.width
        self.generator = nn.Sequential(*_layers((config.noise_columns, *config.generator_layers, width)), nn.Tanh())
        self.discriminator = nn.Sequential(*_layers((width, *config.discriminator_layers, 1)), nn.Sigmoid())
        self.register_buffer("low", torch.zeros(width))
        self.register_buffer("high", torch.ones(width))

    def sample(self, count: int, rng: torch.Generator) -> Tensor:
        """Draw rows."""
        with torch.inference_mode():
            noise = self.config.noise_sd * torch.randn(count, self.config.noise_columns, generator=rng)
            return torch.lerp(self.low, self.high, (self.generator(noise.to(self.low.device)) + 1) / 2)

    def scaled(self, rows: Tensor) -> Tensor:
        """Return rows (N, width) with each column's training range as −1…1."""
        return 2 * (rows - self.low) / (self.high - self.low).clamp(min=1e-9) - 1


class GanTraining(GeneratorTraining):
    """Generator against discriminator, equation (2)."""

    generator: Gan
    train_rows: Tensor
    validation_rows: Tensor

    def __init__(self, generator: Gan, real: RealRows) -> None:
        super().__init__(generator)
        generator.low.copy_(real.train.min(dim=0).values)
        generator.high.copy_(real.train.max(dim=0).values)
        self.register_buffer("train_rows", generator.scaled(real.train))
        self.register_buffer("validation_rows", real.validation)

    def configure_optimizers(self) -> Any:
        """Adam for each of the two."""
        config = self.generator.config
        return [
            torch.optim.Adam(network.parameters(), lr=config.learning_rate, betas=(config.beta1, 0.999), fused=True)
            for network in (self.generator.generator, self.generator.discriminator)
        ]

    def training_step(self, step: int, batch_index: int) -> dict[str, Tensor]:
        """Let the discriminator learn some steps, and then the generator one."""
        config, discriminator = self.generator.config, self.generator.discriminator
        half = config.batch_size // 2
        ones, zeros = torch.ones(half, 1, device=self.device), torch.zeros(half, 1, device=self.device)
        for _ in range(config.discriminator_steps):
            real = self.train_rows[torch.randint(len(self.train_rows), (half,), device=self.device)]
            judged = discriminator(torch.cat([real, self._fake(half).detach()]))
            discriminator_loss = binary_cross_entropy(judged, torch.cat([ones, zeros]))
            self.descend(discriminator_loss, optimiser=1)
        generator_loss = binary_cross_entropy(discriminator(self._fake(half)), ones)
        self.descend(generator_loss, optimiser=0)
        return {"generator_loss": generator_loss.detach(), "discriminator_loss": discriminator_loss.detach()}

    def validation_figures(self) -> dict[str, float]:
        """Return the authors' score: the mean distance to the 8 nearest real rows, all scaled to 0…1."""
        rows = (self.generator.sample(1000, torch.Generator().manual_seed(0)), self.validation_rows)
        drawn, real = (((self.generator.scaled(part) + 1) / 2).cpu().numpy() for part in rows)
        return {"validation_neighbour_distance": mean_neighbour_distance(drawn, real)}

    def _fake(self, count: int) -> Tensor:
        config = self.generator.config
        noise = config.noise_sd * torch.randn(count, config.noise_columns, device=self.device)
        fake: Tensor = self.generator.generator(noise)
        return fake


def _layers(widths: Sequence[int]) -> list[nn.Module]:
    """Return linear layers with LeakyReLU between them."""
    layers: list[nn.Module] = []
    for pair in pairwise(widths):
        layers += [nn.Linear(*pair), nn.LeakyReLU()]
    return layers[:-1]


class Config(GeneratorConfig):
    """`conf/generator/gan.yaml`.

    Attributes:
        noise_columns: how many random numbers a row is made of.
        noise_sd: their standard deviation.
        generator_layers: widths of the generator's hidden layers.
        discriminator_layers: likewise of the discriminator's.
        learning_rate: of both.
        beta1: Adam's averaging of the gradient.
        batch_size: rows a step, half of them real.
        discriminator_steps: for each of the generator's.
        steps: of the generator.
    """

    name: Literal["gan"] = "gan"
    noise_columns: Steps = 6
    noise_sd: Positive = 0.2
    generator_layers: tuple[Steps, ...] = (32, 16, 8)
    discriminator_layers: tuple[Steps, ...] = (32, 16, 8, 6)
    learning_rate: Positive = 2e-4
    beta1: Annotated[float, Field(ge=0, lt=1)] = 0.4
    batch_size: Annotated[int, Field(ge=2)] = 64
    discriminator_steps: Steps = 3
    steps: Steps = 7000

    @property
    def training_steps(self) -> int:
        """The generator's steps."""
        return self.steps

    def build(self, columns: Columns) -> Gan:
        """Build it."""
        return Gan(columns, self)

    def training(self, generator: Generator, real: RealRows) -> GanTraining:
        """Return its training."""
        assert isinstance(generator, Gan)
        return GanTraining(generator, real)
