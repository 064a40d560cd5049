"""Several small additive networks side by side, each of which has not seen one part of the runs."""

from collections.abc import Sequence

import numpy as np
import torch
from torch import Tensor, nn

WIDTH = 32
FULL_WIDTH = 64
LEARNING_RATE = 0.01
WEIGHT_DECAY = 0.1
BATCH, LARGE_BATCH = 256, 1024
STEPS, MORE_STEPS = 1000, 1600
MANY = 12_000
WARM_UP = 0.1


class Layer(nn.Module):
    """A linear layer of each of M members, (M, rows, inputs) → (M, rows, outputs)."""

    def __init__(self, members: int, inputs: int, outputs: int) -> None:
        super().__init__()
        alike = torch.randn(1, inputs, outputs) / inputs**0.5
        self.weight = nn.Parameter(alike.repeat(members, 1, 1))
        self.bias = nn.Parameter(torch.zeros(members, 1, outputs))

    def forward(self, values: Tensor, member: int | None = None) -> Tensor:
        """Apply it; of one member where one is named, (rows, inputs) → (rows, outputs)."""
        if member is not None:
            return torch.addmm(self.bias[member], values, self.weight[member])
        return torch.baddbmm(self.bias, values, self.weight)


class Ensemble(nn.Module):
    """M members, each a sum of perceptrons that look at groups of the inputs.

    A sum, since what two wheels do adds up, and what the command does and what the walls add nearly does: a few
    thousand transitions suffice where one perceptron over all inputs would need ten times as many.

    Args:
        members: how many.
        groups: the input columns that each perceptron looks at, the last one at all of them.
        outputs: columns of the answer.
    """

    offset: Tensor
    scale: Tensor

    def __init__(self, members: int, groups: Sequence[Sequence[int]], outputs: int = 3) -> None:
        super().__init__()
        self.members = members
        self.groups = [list(group) for group in groups]
        self.parts = nn.ModuleList()
        self._layers: list[tuple[Layer, Layer, Layer]] = []
        for number, group in enumerate(self.groups):
            width = FULL_WIDTH if number == len(self.groups) - 1 and len(group) > 4 else WIDTH
            layers = (Layer(members, len(group), width), Layer(members, width, width), Layer(members, width, outputs))
            with torch.no_grad():
                layers[-1].weight.mul_(0.3)
            self.parts.append(nn.ModuleList(layers))
            self._layers.append(layers)
        self.register_buffer("offset", torch.zeros(outputs))
        self.register_buffer("scale", torch.ones(outputs))

    def scaled(self, inputs: Tensor) -> Tensor:
        """Return the members' answers (M, N, outputs) in units of the outputs' spread."""
        total: Tensor | None = None
        for group, (first, second, last) in zip(self.groups, self._layers, strict=True):
            hidden = torch.relu(first(inputs[:, group].expand(self.members, len(inputs), len(group))))
            answer = last(torch.relu(second(hidden)))
            total = answer if total is None else total + answer
        assert total is not None
        return total

    def forward(self, inputs: Tensor) -> Tensor:
        """Return the members' answers (M, N, outputs) to inputs (N, columns)."""
        answers: Tensor = self.scaled(inputs) * self.scale + self.offset
        return answers

    def answer(self, inputs: Tensor, member: int) -> Tensor:
        """Return one member's answers (N, outputs)."""
        total = torch.zeros(len(inputs), len(self.offset))
        for group, (first, second, last) in zip(self.groups, self._layers, strict=True):
            hidden = torch.relu(first(inputs[:, group], member))
            total = total + last(torch.relu(second(hidden, member)), member)
        answers: Tensor = total * self.scale + self.offset
        return answers


def learn(
    groups: Sequence[Sequence[int]],
    inputs: np.ndarray,
    outputs: np.ndarray,
    fold: np.ndarray,
    seed: int,
    weight: np.ndarray | None = None,
) -> Ensemble:
    """Train one member a fold, each on all rows but those of its fold.

    Args:
        groups: the input columns that each part looks at.
        inputs: (N, columns), about 1 in size.
        outputs: (N, d).
        fold: (N,) numbers from 0, whole runs in a fold.
        seed: of weights and batches.
        weight: (N, d) how much each number counts, or None.
    """
    members = int(fold.max()) + 1
    batch, steps = (BATCH, STEPS) if len(inputs) < MANY else (LARGE_BATCH, MORE_STEPS)
    generator = torch.Generator().manual_seed(seed)
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(seed)
        ensemble = Ensemble(members, groups, outputs.shape[1])
    given = torch.as_tensor(inputs, dtype=torch.float32)
    wanted = torch.as_tensor(outputs, dtype=torch.float32)
    offset, scale = wanted.mean(dim=0), wanted.std(dim=0).clamp(min=1e-6)
    ensemble.offset.copy_(offset)
    ensemble.scale.copy_(scale)
    wanted = (wanted - offset) / scale
    counts = torch.as_tensor(fold[None] != np.arange(members)[:, None], dtype=torch.float32)
    importance = torch.ones(len(given), 1) if weight is None else torch.as_tensor(weight, dtype=torch.float32)
    optimiser = torch.optim.AdamW(ensemble.parameters(), lr=LEARNING_RATE, weight_decay=WEIGHT_DECAY)
    schedule = torch.optim.lr_scheduler.OneCycleLR(optimiser, LEARNING_RATE, total_steps=steps, pct_start=WARM_UP)
    for _ in range(steps):
        rows = torch.randint(0, len(given), (batch,), generator=generator)
        error = ((ensemble.scaled(given[rows]) - wanted[rows]) ** 2 * importance[rows]).mean(dim=-1)
        loss = members * (error * counts[:, rows]).sum() / counts[:, rows].sum()
        optimiser.zero_grad()
        loss.backward()
        optimiser.step()
        schedule.step()
    return ensemble.eval()


def folds_of(run: np.ndarray, count: int) -> np.ndarray:
    """Give each row (N,) a fold, whole runs in turn; there are at most as many folds as runs."""
    _, rank = np.unique(run, return_inverse=True)
    folds: np.ndarray = rank % min(count, int(rank.max()) + 1)
    return folds
