"""Each column turned into a normal score and back: limits, repeated values and steps come back as they were."""

import torch
from torch import Tensor, nn


class MarginalDistributions(nn.Module):
    """The quantiles of each column at evenly spaced probabilities, the lowest and highest value included.

    Columns whose values have few decimals, as commands do, keep their number: a command of 0.1 steps is drawn in them.
    """

    quantiles: Tensor
    decimals: Tensor

    def __init__(self, columns: int, knots: int) -> None:
        super().__init__()
        self.register_buffer("quantiles", torch.zeros(knots, columns))
        self.register_buffer("decimals", torch.full((columns,), -1))

    def learn(self, values: Tensor) -> None:
        """Take the quantiles and decimals of values (N, columns)."""
        probabilities = torch.linspace(0, 1, len(self.quantiles))
        self.quantiles.copy_(torch.quantile(values, probabilities, dim=0))
        self.decimals.copy_(torch.tensor([_decimals(column) for column in values.double().T]))

    @staticmethod
    def scores(values: Tensor) -> Tensor:
        """Return the normal scores (N, columns) of the ranks; equal values are ranked at random."""
        shuffled = torch.argsort(torch.rand(values.shape), dim=0)
        order = torch.argsort(values.gather(0, shuffled), dim=0, stable=True)
        rank = torch.empty_like(order)
        rank.scatter_(0, shuffled.gather(0, order), torch.arange(len(values))[:, None].expand_as(order).contiguous())
        return torch.special.ndtri((rank + 0.5) / len(values))

    def values(self, scores: Tensor) -> Tensor:
        """Return the values (N, columns), float64, that have these normal scores."""
        position = torch.special.ndtr(scores) * (len(self.quantiles) - 1)
        below = position.floor().clamp(0, len(self.quantiles) - 2).long()
        low, high = (self.quantiles.gather(0, knot).double() for knot in (below, below + 1))
        values = torch.lerp(low, high, (position - below).double())
        columns = zip(values.T, self.decimals.tolist(), strict=True)
        return torch.stack([column if d < 0 else column.round(decimals=d) for column, d in columns], dim=1)


def _decimals(column: Tensor) -> int:
    """Return how many decimals the values (N,) have, −1 where there are more than three, as in measured ones."""
    for decimals in range(4):
        if (column - column.round(decimals=decimals)).abs().max() < 10.0**-decimals / 50:
            return decimals
    return -1
