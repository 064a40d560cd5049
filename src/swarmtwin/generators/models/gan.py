"""The published generative adversarial network (section 3.2 of the paper, equation 2; sizes from the authors' code)."""

from collections.abc import Sequence
from itertools import pairwise
from typing import Annotated, Any, Literal, cast

import torch
from pydantic import Field
from torch import Tensor, nn
from torch.nn.functional import binary_cross_entropy

from swarmtwin.generators.base import Generator, RealRows
from swarmtwin.generators.closeness import mean_neighbour_distance
from swarmtwin.generators.generator_config import GeneratorConfig, Steps
from swarmtwin.robot import Positive, Robot

SCORED = 1000


class Gan(Generator):
    """Noise → whole rows, scaled to −1…1, against a discriminator that tells them from real ones.

    As the authors published it, in width and depth, loss and optimiser; only the number of columns follows the robot.
    Nothing ties the displacement to the command but the discriminator, and nothing keeps the noise from collapsing.
    """

    config: "Config"
    low: Tensor
    high: Tensor

    def __init__(self, robot: Robot, config: "Config") -> None:
        super().__init__(robot, config)
        width = self.columns.width
        self.generator = nn.Sequential(*_layers((config.noise_columns, *config.generator_layers, width)), nn.Tanh())
        self.discriminator = nn.Sequential(*_layers((width, *config.discriminator_layers, 1)), nn.Sigmoid())
        self.register_buffer("low", torch.zeros(width))
        self.register_buffer("high", torch.ones(width))

    def start(self, real: RealRows) -> None:
        """Take each column's range."""
        self.real = real
        self.low.copy_(real.train.min(dim=0).values)
        self.high.copy_(real.train.max(dim=0).values)
        self._scaled = self._scale(real.train)

    def configure_optimizers(self) -> Any:
        """Adam for each of the two."""
        rate, betas = self.config.learning_rate, (self.config.beta1, 0.999)
        return [
            torch.optim.Adam(network.parameters(), lr=rate, betas=betas, fused=True)
            for network in (self.generator, self.discriminator)
        ]

    def training_step(self, step: int, batch_index: int) -> dict[str, Tensor]:
        """Let the discriminator learn some steps, and then the generator one, equation (2)."""
        generating, discriminating = cast(Any, self.optimizers(use_pl_optimizer=False))
        half = self.config.batch_size // 2
        for _ in range(self.config.discriminator_steps):
            real = self._scaled[torch.randint(len(self._scaled), (half,))]
            judged = self.discriminator(torch.cat([real, self._fake(half).detach()]))
            truth = torch.cat([torch.ones(half, 1), torch.zeros(half, 1)])
            discriminator_loss = binary_cross_entropy(judged, truth)
            self._optimise(discriminating, discriminator_loss)
        believed = self.discriminator(self._fake(half))
        generator_loss = binary_cross_entropy(believed, torch.ones(half, 1))
        self._optimise(generating, generator_loss)
        return {"generator_loss": generator_loss.detach(), "discriminator_loss": discriminator_loss.detach()}

    def validation_figures(self) -> dict[str, float]:
        """Return the authors' score: the mean distance to the 8 nearest real rows, all scaled to 0…1."""
        source = torch.Generator().manual_seed(0)
        drawn, real = self.draw(SCORED, source), self.real.validation
        scaled = [((self._scale(rows) + 1) / 2).numpy() for rows in (drawn, real)]
        return {"validation_neighbour_distance": mean_neighbour_distance(*scaled)}

    def draw(self, count: int, source: torch.Generator) -> Tensor:
        """Draw rows."""
        with torch.inference_mode():
            noise = self.config.noise_sd * torch.randn(count, self.config.noise_columns, generator=source)
            return torch.lerp(self.low, self.high, (self.generator(noise) + 1) / 2)

    def _fake(self, count: int) -> Tensor:
        fake: Tensor = self.generator(self.config.noise_sd * torch.randn(count, self.config.noise_columns))
        return fake

    def _scale(self, rows: Tensor) -> Tensor:
        return 2 * (rows - self.low) / (self.high - self.low).clamp(min=1e-9) - 1

    def _optimise(self, optimiser: Any, loss: Tensor) -> None:
        optimiser.zero_grad()
        self.manual_backward(loss)
        optimiser.step()


def _layers(widths: Sequence[int]) -> list[nn.Module]:
    """Return linear layers with LeakyReLU between them."""
    layers: list[nn.Module] = []
    for pair in pairwise(widths):
        layers += [nn.Linear(*pair), nn.LeakyReLU()]
    return layers[:-1]


class Config(GeneratorConfig):
    """`conf/generator/gan.yaml`."""

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

    def build(self, robot: Robot) -> Gan:
        """Build it."""
        return Gan(robot, self)
