"""An ensemble whose members each answer with a normal distribution (PETS: Chua et al. 2018)."""

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from swarmtwin.learning.ensemble import Ensemble


class MeanVarianceEnsemble(nn.Module):
    """M perceptrons: scaled inputs (N, inputs) → mean and variance of scaled displacements, (M, N, 3) each.

    Within a member, the variance is what differs from period to period; between members, the means are what the
    measured runs and vehicles leave open.

    Attributes:
        members: how many.
        variance_weight: β of the loss.
        spread_factor: (3,) what calibration multiplies the standard deviations by; 1 before.
    """

    spread_factor: Tensor

    def __init__(
        self, inputs: int, members: int, layers: tuple[int, ...], variance_weight: float, least_variance: float = 1e-6
    ) -> None:
        super().__init__()
        self.members = members
        self.variance_weight = variance_weight
        self.least_variance = least_variance
        self.perceptrons = Ensemble(members, [range(inputs)], outputs=6, layers=layers, alike=False)
        self.register_buffer("spread_factor", torch.ones(3))

    def forward(self, inputs: Tensor) -> Tensor:
        """Return the mean over members, (N, 3)."""
        return self.perceptrons.mean(inputs)[:, :3]

    def moments(self, inputs: Tensor) -> tuple[Tensor, Tensor]:
        """Return every member's mean and variance, (M, N, 3) each, not calibrated."""
        mean, free = self.perceptrons(inputs).split(3, dim=-1)
        return mean, F.softplus(free) + self.least_variance

    def loss(self, inputs: Tensor, outputs: Tensor, counts: Tensor) -> Tensor:
        """Return the β-weighted negative log-likelihood (Seitzer et al. 2022), the mean over members and outputs.

        Likelihood alone gives what a member takes for noisy little weight, and so it goes on erring there. Each term is
        multiplied by its variance to the power of β, through which no gradient flows.

        Args:
            inputs: (N, inputs).
            outputs: (N, 3) scaled displacements.
            counts: (N, M) how often each row counts for each member.
        """
        mean, variance = self.moments(inputs)
        surprise = ((outputs - mean) ** 2 / variance + variance.log()) / 2
        weighted = variance.detach() ** self.variance_weight * surprise * counts.T[..., None]
        return weighted.sum(dim=1).div(counts.sum(dim=0).clamp(min=1.0)[:, None]).mean()
