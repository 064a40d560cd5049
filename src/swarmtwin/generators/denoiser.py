"""A diffusion model of few columns, given a condition: along an angle from data to noise."""

import math
from itertools import pairwise

import torch
from torch import Tensor, nn


class Denoiser(nn.Module):
    """Learns to take noise away from values of unit spread (N, columns), given a condition (N, conditions).

    At angle φ a value x and noise z of the same spread are mixed to cos φ · x + sin φ · z, from the value at 0 to noise
    alone at π/2. The network learns how the mixture changes with φ (TrigFlow, Lu and Song 2024): where the values are
    normal that is nothing at all, so few steps bring noise back to data without widening it.
    """

    def __init__(self, columns: int, conditions: int, width: int) -> None:
        super().__init__()
        self.columns = columns
        stack: list[nn.Module] = []
        for pair in pairwise((columns + conditions + 4, width, width)):
            stack += [nn.Linear(*pair), nn.SiLU()]
        self.network = nn.Sequential(*stack, nn.Linear(width, columns))

    def forward(self, mixture: Tensor, angle: Tensor, condition: Tensor) -> Tensor:
        """Estimate the change (N, columns) per rad of mixtures (N, columns) at angles (N, 1)."""
        waves = [angle.cos(), angle.sin(), (2 * angle).cos(), (2 * angle).sin()]
        change: Tensor = self.network(torch.cat([mixture, condition, *waves], dim=1))
        return change

    def loss(self, values: Tensor, condition: Tensor) -> Tensor:
        """Return the mean squared error of the change of values (N, columns) at random angles."""
        angle = math.pi / 2 * torch.rand(len(values), 1, device=values.device)
        noise = torch.randn_like(values)
        change = angle.cos() * noise - angle.sin() * values
        return (self(angle.cos() * values + angle.sin() * noise, angle, condition) - change).square().mean()

    def sample(self, condition: Tensor, steps: int, rng: torch.Generator) -> Tensor:
        """Draw values (N, columns) for conditions (N, conditions): from noise to data by Heun's method."""
        values = torch.randn(len(condition), self.columns, generator=rng).to(condition.device)
        for angle, lower in pairwise(torch.linspace(math.pi / 2, 0, steps + 1).tolist()):
            change = self._change(values, angle, condition)
            ahead = values + (lower - angle) * change
            values = values + (lower - angle) * (change + self._change(ahead, lower, condition)) / 2
        return values

    def _change(self, values: Tensor, angle: float, condition: Tensor) -> Tensor:
        change: Tensor = self(values, torch.full((len(values), 1), angle, device=values.device), condition)
        return change
