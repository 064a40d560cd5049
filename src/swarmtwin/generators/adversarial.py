"""Adversarial training (equation 2 of the paper): one loop for all generators that learn against a discriminator.

They differ in networks, in the noise that rows are made of and in the loss, which are data to it.
"""

from abc import abstractmethod
from collections.abc import Callable, Iterable
from dataclasses import dataclass
from typing import Annotated, Any, ClassVar, NamedTuple, Self

import torch
from pydantic import Field
from torch import Tensor, nn
from torch.nn.functional import binary_cross_entropy

from swarmtwin.generators.generator import Generator, GeneratorConfig, GeneratorTraining, RealRows, Steps
from swarmtwin.generators.quality import mean_neighbour_distance
from swarmtwin.robot import Positive


class AdversarialLoss(NamedTuple):
    """What the two players make small.

    Attributes:
        discriminator: of its scores of real and of generated rows, each (N, 1).
        generator: of the discriminator's scores of generated rows, (N, 1).
    """

    discriminator: Callable[[Tensor, Tensor], Tensor]
    generator: Callable[[Tensor], Tensor]


def _cross_entropy(real: Tensor, generated: Tensor) -> Tensor:
    truth = torch.cat([torch.ones_like(real), torch.zeros_like(generated)])
    return binary_cross_entropy(torch.cat([real, generated]), truth)


def _cross_entropy_as_real(generated: Tensor) -> Tensor:
    return binary_cross_entropy(generated, torch.ones_like(generated))


def _squares(real: Tensor, generated: Tensor) -> Tensor:
    return ((real - 1).square().mean() + generated.square().mean()) / 2


def _squares_as_real(generated: Tensor) -> Tensor:
    return (generated - 1).square().mean()


CROSS_ENTROPY = AdversarialLoss(_cross_entropy, _cross_entropy_as_real)
"""Of probabilities, with the generator's loss that does not saturate (Goodfellow et al. 2014)."""

LEAST_SQUARES = AdversarialLoss(_squares, _squares_as_real)
"""Of unbounded scores, 1 for real and 0 for generated (Mao et al. 2017)."""


def scaled_to_range(rows: Tensor, low: Tensor, high: Tensor) -> Tensor:
    """Return rows (N, columns) with each column's range, from `low` to `high`, as −1…1."""
    return 2 * (rows - low) / (high - low).clamp(min=1e-9) - 1


def normal(count: int, columns: int, device: torch.device, rng: torch.Generator | None = None) -> Tensor:
    """Draw normal noise (count, columns); on the CPU where `rng` is given, so that every device gets the same."""
    return torch.randn(count, columns, generator=rng, device="cpu" if rng else device).to(device)


@dataclass(frozen=True)
class RealBatches:
    """Real rows to draw from: (N, columns), as the networks see them, and how many a batch holds."""

    rows: Tensor
    size: int

    def draw(self) -> Tensor:
        """Return a random batch (size, columns)."""
        return self.rows[torch.randint(len(self.rows), (self.size,), device=self.rows.device)]


class AdversarialGenerator(Generator):
    """A generator with a discriminator, which is kept with it.

    Attributes:
        loss: what the two make small.
        judged_apart: whether real and generated rows are judged in batches of their own, as batch normalisation needs.
        generator: the network that makes rows.
        discriminator: the network that scores them, (N, columns) → (N, 1).
    """

    loss: ClassVar[AdversarialLoss] = CROSS_ENTROPY
    config: "AdversarialConfig"
    judged_apart: bool
    generator: nn.Module
    discriminator: nn.Module

    @abstractmethod
    def learn_scaling(self, rows: Tensor) -> None:
        """Take from training rows (N, width) what is not learned by gradients."""

    @abstractmethod
    def scaled(self, rows: Tensor) -> Tensor:
        """Return rows (N, width) as the discriminator sees them, (N, columns)."""

    @abstractmethod
    def generated(self, real: RealBatches) -> Tensor:
        """Return as many generated rows as a real batch holds, (size, columns), with gradients."""

    def players(self) -> tuple[list[nn.Parameter], list[nn.Parameter]]:
        """Return the parameters of what generates, and of what discriminates."""
        judging = [*self.discriminator.parameters()]
        judging_too = {id(parameter) for parameter in judging}
        return [own for own in self.parameters() if id(own) not in judging_too], judging

    def discriminator_loss(self, real: RealBatches) -> Tensor:
        """Return the discriminator's loss on a real batch and a generated one."""
        rows = real.draw()
        with torch.no_grad():
            generated = self.generated(real)
        return self.loss.discriminator(*judge(self.discriminator, rows, generated, self.judged_apart))

    def generator_loss(self, real: RealBatches) -> Tensor:
        """Return the generator's loss on a generated batch."""
        return self.loss.generator(self.discriminator(self.generated(real)))


def judge(discriminator: nn.Module, real: Tensor, generated: Tensor, apart: bool) -> tuple[Tensor, Tensor]:
    """Return the scores of real and of generated rows, judged `apart` or as one batch."""
    if apart:
        return discriminator(real), discriminator(generated)
    scores = discriminator(torch.cat([real, generated]))
    return scores[: len(real)], scores[len(real) :]


class AdversarialTraining(GeneratorTraining):
    """Generator against discriminator, for any `AdversarialGenerator`."""

    generator: AdversarialGenerator
    train_rows: Tensor
    validation_rows: Tensor
    low: Tensor
    high: Tensor

    def __init__(self, generator: AdversarialGenerator, real: RealRows) -> None:
        super().__init__(generator)
        generator.learn_scaling(real.train)
        self.register_buffer("train_rows", generator.scaled(real.train))
        self.register_buffer("validation_rows", real.validation)
        self.register_buffer("low", real.train.min(dim=0).values)
        self.register_buffer("high", real.train.max(dim=0).values)

    def configure_optimizers(self) -> Any:
        """Adam for each of the two players."""
        config = self.generator.config
        return [self._optimiser(player, config.learning_rate) for player in self.generator.players()]

    def training_step(self, step: int, batch_index: int) -> dict[str, Tensor]:
        """Let the discriminator learn some steps, and then the generator one."""
        generator, config = self.generator, self.generator.config
        real = RealBatches(self.train_rows, config.batch_size // 2)
        learning_rate = config.learning_rate * config.learning_rate_share(step)
        for _ in range(config.discriminator_steps):
            discriminator_loss = generator.discriminator_loss(real)
            self.descend(discriminator_loss, 1, learning_rate)
        generator_loss = generator.generator_loss(real)
        self.descend(generator_loss, 0, learning_rate)
        return {"generator_loss": generator_loss.detach(), "discriminator_loss": discriminator_loss.detach()}

    def validation_figures(self) -> dict[str, float]:
        """Return the authors' score: the mean distance to the 8 nearest real rows, all scaled to 0…1."""
        self.generator.eval()
        rows = (self.generator.sample(1000, torch.Generator().manual_seed(0)), self.validation_rows)
        self.generator.train()
        drawn, real = (((scaled_to_range(part, self.low, self.high) + 1) / 2).cpu().numpy() for part in rows)
        return {"validation_neighbour_distance": mean_neighbour_distance(drawn, real)}

    def _optimiser(self, parameters: Iterable[nn.Parameter], learning_rate: float) -> torch.optim.Optimizer:
        betas = (self.generator.config.beta1, 0.999)
        return torch.optim.Adam(parameters, lr=learning_rate, betas=betas, fused=True)


class AdversarialConfig(GeneratorConfig):
    """What the configurations of all adversarial generators have.

    Attributes:
        learning_rate: of both players.
        decay_from: share of the training after which the learning rate falls to zero along a line; 1: it does not.
        beta1: Adam's averaging of the gradient.
        batch_size: rows a step, half of them real.
        discriminator_steps: for each of the generator's.
        steps: of the generator.
        epochs: passes of the discriminator over the real rows, instead of `steps`; null: `steps` holds.
    """

    learning_rate: Positive = 2e-4
    decay_from: Annotated[float, Field(ge=0, le=1)] = 1.0
    beta1: Annotated[float, Field(ge=0, lt=1)] = 0.5
    batch_size: Annotated[int, Field(ge=4)] = 128
    discriminator_steps: Steps = 1
    steps: Steps = 7000
    epochs: Positive | None = None

    @property
    def training_steps(self) -> int:
        """The generator's steps."""
        return self.steps

    def completed(self, rows: int) -> Self:
        """Return it with the steps that its `epochs` over `rows` real rows take."""
        if self.epochs is None:
            return self
        seen_in_a_step = self.batch_size // 2 * self.discriminator_steps
        return self.model_copy(update={"steps": max(1, round(self.epochs * rows / seen_in_a_step))})

    def learning_rate_share(self, step: int) -> float:
        """Return the share of the learning rate at `step`, from 0."""
        constant = self.decay_from * self.steps
        return 1.0 if step < constant else (self.steps - step) / (self.steps - constant)

    def training(self, generator: Generator, real: RealRows) -> AdversarialTraining:
        """Return its training."""
        assert isinstance(generator, AdversarialGenerator)
        return AdversarialTraining(generator, real)
