"""The expected displacement, by an ensemble whose members each leave out a part of the runs."""

import math
from collections.abc import Sequence
from itertools import pairwise

import torch
from torch import Tensor, nn


class MemberLinear(nn.Module):
    """A linear layer for each of several members: (members, N, inputs) → (members, N, outputs)."""

    def __init__(self, members: int, inputs: int, outputs: int) -> None:
        super().__init__()
        bound = 1 / math.sqrt(inputs)
        self.weight = nn.Parameter(torch.empty(members, inputs, outputs).uniform_(-bound, bound))
        self.bias = nn.Parameter(torch.empty(members, 1, outputs).uniform_(-bound, bound))

    def forward(self, values: Tensor) -> Tensor:
        """Apply each member's layer to its own values."""
        return torch.baddbmm(self.bias, values, self.weight)


class Trend(nn.Module):
    """Features → displacement, as the mean of several perceptrons.

    Member k learns from all runs but those of fold k. So every real row has a member that has not seen it, and the
    residual by that member is honest: the noise is not taken for smaller than it is, as it would be with residuals of
    rows learned by heart. The mean over members is smoother than each, which is what counts where data are few.
    """

    offset: Tensor
    scale: Tensor

    def __init__(self, features: int, members: int, layers: Sequence[int]) -> None:
        super().__init__()
        self.members = members
        widths = (features, *layers, 3)
        self.layers = nn.ModuleList(MemberLinear(members, *pair) for pair in pairwise(widths))
        self.register_buffer("offset", torch.zeros(3))
        self.register_buffer("scale", torch.ones(3))

    def learn_scaling(self, displacement: Tensor) -> None:
        """Take mean and spread of displacements (N, 3)."""
        self.offset.copy_(displacement.mean(dim=0))
        self.scale.copy_(displacement.std(dim=0).clamp(min=1e-3))

    def by_member(self, features: Tensor) -> Tensor:
        """Predict displacements (members, N, 3) from features (members, N, width)."""
        values = features
        for layer in self.layers[:-1]:
            values = layer(values).relu()
        return self.offset + self.scale * self.layers[-1](values)

    def forward(self, features: Tensor) -> Tensor:
        """Predict displacements (N, 3) from features (N, width)."""
        return self.by_member(features.expand(self.members, -1, -1)).mean(dim=0)

    def held_out(self, features: Tensor, fold: Tensor) -> Tensor:
        """Predict displacements (N, 3), each by the member that did not learn from its fold (N,)."""
        predicted = self.by_member(features.expand(self.members, -1, -1))
        return predicted[fold, torch.arange(len(fold))]


def folds(run: Tensor, members: int) -> Tensor:
    """Give each row (N,) a fold: whole runs in a random order in turn, or rows where there are fewer runs."""
    runs = int(run.max()) + 1
    if runs < members:
        return torch.randperm(len(run)) % members
    return (torch.randperm(runs) % members)[run]
