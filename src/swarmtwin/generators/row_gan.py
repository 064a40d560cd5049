"""Generative adversarial networks that make a whole row of noise: situation and displacement together."""

from abc import abstractmethod
from collections.abc import Sequence
from itertools import pairwise
from typing import ClassVar, Literal, NamedTuple

import torch
from torch import Tensor, nn

from swarmtwin.generators.adversarial import (
    AdversarialConfig,
    AdversarialGenerator,
    RealBatches,
    normal,
    scaled_to_range,
)
from swarmtwin.generators.columns import Columns


class NormalNoise(nn.Module):
    """The noise of one normal distribution of standard deviation `sd` in every column."""

    def __init__(self, columns: int, sd: float = 1.0) -> None:
        super().__init__()
        self.columns = columns
        self.sd = sd

    def forward(self, count: int, device: torch.device, rng: torch.Generator | None) -> Tensor:
        """Draw (count, columns)."""
        return self.sd * normal(count, self.columns, device, rng)


class Networks(NamedTuple):
    """What a generative adversarial network is made of.

    Attributes:
        noise: (count, device, random numbers or None for torch's own) → noise (count, noise columns).
        generator: noise → rows (N, columns) in −1…1.
        discriminator: such rows → scores (N, 1), as its loss wants them.
    """

    noise: nn.Module
    generator: nn.Module
    discriminator: nn.Module


class RowGan(AdversarialGenerator):
    """Noise → whole rows, each column scaled to −1…1; nothing but the discriminator ties displacement to situation."""

    config: "RowGanConfig"
    low: Tensor
    high: Tensor

    def __init__(self, columns: Columns, config: "RowGanConfig") -> None:
        super().__init__(columns, config)
        self.judged_apart = config.judged_apart
        width = columns.width + (len(columns.headings) if config.headings == "direction" else 0)
        self.noise, self.generator, self.discriminator = config.networks(width)
        self.register_buffer("low", torch.zeros(width))
        self.register_buffer("high", torch.ones(width))

    def sample(self, count: int, rng: torch.Generator) -> Tensor:
        """Draw rows."""
        with torch.inference_mode():
            made = self.generator(self.noise(count, self.low.device, rng))
            return self._as_rows(torch.lerp(self.low, self.high, (made + 1) / 2))

    def generated(self, real: RealBatches) -> Tensor:
        """Return rows of noise alone, whatever the real ones are."""
        made: Tensor = self.generator(self.noise(real.size, self.low.device, None))
        return made

    def learn_scaling(self, rows: Tensor) -> None:
        """Take each column's range."""
        seen = self._as_seen(rows)
        self.low.copy_(seen.min(dim=0).values)
        self.high.copy_(seen.max(dim=0).values)

    def scaled(self, rows: Tensor) -> Tensor:
        """Return rows with each column's training range as −1…1."""
        return scaled_to_range(self._as_seen(rows), self.low, self.high)

    def _as_seen(self, rows: Tensor) -> Tensor:
        return self.columns.with_directions(rows) if self.config.headings == "direction" else rows

    def _as_rows(self, seen: Tensor) -> Tensor:
        return self.columns.with_angles(seen) if self.config.headings == "direction" else seen


class RowGanConfig(AdversarialConfig):
    """What the configurations of all generators of whole rows have.

    Attributes:
        headings: how the networks see headings: as an angle, which jumps at ±π, or as a direction, cosine and sine.
    """

    judged_apart: ClassVar[bool] = False
    headings: Literal["angle", "direction"] = "direction"

    @abstractmethod
    def networks(self, width: int) -> Networks:
        """Return noise, generator and discriminator, untrained, for rows of `width` columns."""

    def build(self, columns: Columns) -> RowGan:
        """Build it."""
        return RowGan(columns, self)


def perceptron(widths: Sequence[int], slope: float = 0.01) -> list[nn.Module]:
    """Return linear layers from the first to the last of `widths`, with LeakyReLU of that slope between them."""
    layers: list[nn.Module] = []
    for pair in pairwise(widths):
        layers += [nn.Linear(*pair), nn.LeakyReLU(slope)]
    return layers[:-1]
