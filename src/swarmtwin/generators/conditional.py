"""Generators that draw a situation first, and then a displacement for it."""

from abc import abstractmethod
from typing import Protocol

import torch
from torch import Tensor

from swarmtwin.generators.columns import Columns
from swarmtwin.generators.denoiser import Denoiser
from swarmtwin.generators.generator import Generator, GeneratorConfig
from swarmtwin.generators.marginal_distributions import MarginalDistributions
from swarmtwin.geometry import wrap_angle
from swarmtwin.learning.encoding import Encoding
from swarmtwin.robot import SituationPart


class ConditionalOptions(Protocol):
    """What the configuration of such a generator says of situations.

    Attributes:
        wall_reaches: where motion depends on the pose: how far walls are looked for, in the arena's shorter sides.
        place_weight: of position and heading themselves, beside the walls.
        quantiles: that each column of the situation is kept as.
        sampling_steps: of a diffusion model, from noise to data.
    """

    @property
    def wall_reaches(self) -> tuple[float, ...]: ...  # noqa: D102
    @property
    def place_weight(self) -> float: ...  # noqa: D102
    @property
    def quantiles(self) -> int: ...  # noqa: D102
    @property
    def sampling_steps(self) -> int: ...  # noqa: D102


class ConditionalGenerator(Generator):
    """Draws situations, then a displacement for each.

    A diffusion model draws how the situation's columns go together; their own distributions are kept as quantiles.

    Attributes:
        encoding: of situations, as the networks see them.
        situations: draws the normal scores of situations, (N, situation_width).
        marginals: what values have those scores.
    """

    encoding: Encoding
    situations: Denoiser
    marginals: MarginalDistributions

    def __init__(self, columns: Columns, config: GeneratorConfig, options: ConditionalOptions) -> None:
        super().__init__(columns, config)
        self.options = options
        parts: tuple[SituationPart, ...] = ("command", "pose") if columns.has_pose else ("command",)
        reaches, weight = options.wall_reaches, options.place_weight
        self.encoding = Encoding.by_limits(columns.robot, parts, reaches, weight, columns.arena_mm)
        self.marginals = MarginalDistributions(columns.situation_width, options.quantiles)

    @abstractmethod
    def displacements(self, inputs: Tensor, rng: torch.Generator) -> Tensor:
        """Draw a displacement (N, 3) for each of the encoded situations (N, encoding.width)."""

    def inputs(self, situation: Tensor) -> Tensor:
        """Return what the networks are given of situations (N, situation_width), (N, encoding.width)."""
        encoded: Tensor = self.encoding(self.columns.situation(situation))
        return encoded

    def sample(self, count: int, rng: torch.Generator) -> Tensor:
        """Draw situations, then displacements."""
        with torch.inference_mode():
            return torch.cat([self._sample(len(part), rng) for part in torch.empty(count, 0).split(16384)])

    def _sample(self, count: int, rng: torch.Generator) -> Tensor:
        device = self.marginals.quantiles.device
        scores = self.situations.sample(torch.empty(count, 0, device=device), self.options.sampling_steps, rng)
        situation = self.marginals.values(scores)
        displacement = self.displacements(self.inputs(situation.float()), rng)
        displacement[:, 2] = wrap_angle(displacement[:, 2])
        return torch.cat([situation, displacement], dim=1)
