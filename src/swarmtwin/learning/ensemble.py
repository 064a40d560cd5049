"""Several small networks side by side, each of which has not seen one part of the runs."""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise

import numpy as np
import torch
from torch import Tensor, nn


class MemberLinear(nn.Module):
    """A linear layer of each of M members, (M, N, inputs) → (M, N, outputs).

    Args:
        members: how many.
        inputs: columns of the input.
        outputs: columns of the output.
        alike: whether all members begin with the same weights.
    """

    def __init__(self, members: int, inputs: int, outputs: int, alike: bool) -> None:
        super().__init__()
        if alike:
            weight = (torch.randn(1, inputs, outputs) / inputs**0.5).repeat(members, 1, 1)
            bias = torch.zeros(members, 1, outputs)
        else:
            bound = 1 / math.sqrt(inputs)
            weight = torch.empty(members, inputs, outputs).uniform_(-bound, bound)
            bias = torch.empty(members, 1, outputs).uniform_(-bound, bound)
        self.weight = nn.Parameter(weight)
        self.bias = nn.Parameter(bias)

    def forward(self, values: Tensor, member: int | None = None) -> Tensor:
        """Apply it; of one member where one is named, (N, inputs) → (N, outputs)."""
        if member is not None:
            return torch.addmm(self.bias[member], values, self.weight[member])
        return torch.baddbmm(self.bias, values, self.weight)


class Ensemble(nn.Module):
    """M members, each a sum of ReLU perceptrons that look at groups of the inputs.

    A sum, since what two wheels do adds up, and what the command does and what the walls add nearly does: a few
    thousand transitions suffice where one perceptron over all inputs would need ten times as many.

    Where member k learns from all runs but those of fold k, every row has a member that has not seen it, and the
    residual by that member is honest: the noise is not taken for smaller than it is. The mean over members is smoother
    than each, which is what counts where data are few.

    Args:
        members: how many.
        groups: the input columns that each perceptron looks at, the last one at all of them.
        outputs: columns of the answer.
        layers: widths of every perceptron's hidden layers; None: two of 32, of 64 for the last one where it looks at
            more than four columns.
        alike: whether members begin with the same weights, so that they differ by what they have seen alone.
    """

    offset: Tensor
    scale: Tensor

    def __init__(
        self,
        members: int,
        groups: Sequence[Sequence[int]],
        outputs: int = 3,
        layers: Sequence[int] | None = None,
        alike: bool = True,
    ) -> None:
        super().__init__()
        self.members = members
        self.groups = [list(group) for group in groups]
        self.parts = nn.ModuleList()
        for number, group in enumerate(self.groups):
            width = 64 if number == len(self.groups) - 1 and len(group) > 4 else 32
            widths = (len(group), *(layers or (width, width)), outputs)
            layers_of_group = [MemberLinear(members, *pair, alike) for pair in pairwise(widths)]
            if alike:
                with torch.no_grad():  # the sum begins small
                    layers_of_group[-1].weight.mul_(0.3)
            self.parts.append(nn.ModuleList(layers_of_group))
        self.register_buffer("offset", torch.zeros(outputs))
        self.register_buffer("scale", torch.ones(outputs))

    def learn_scaling(self, outputs: Tensor) -> None:
        """Take mean and standard deviation of the outputs (N, outputs) to be learned."""
        self.offset.copy_(outputs.mean(dim=0))
        self.scale.copy_(outputs.std(dim=0).clamp(min=1e-6))

    def scaled(self, inputs: Tensor) -> Tensor:
        """Return the members' answers (M, N, outputs) in standard deviations of the outputs.

        Args:
            inputs: (N, columns), or (M, N, columns) where each member is asked something else.
        """
        return self._sum(inputs, None)

    def forward(self, inputs: Tensor) -> Tensor:
        """Return the members' answers (M, N, outputs) to inputs (N, columns) or (M, N, columns)."""
        return self.scaled(inputs) * self.scale + self.offset

    def answer(self, inputs: Tensor, member: int) -> Tensor:
        """Return one member's answers (N, outputs) to inputs (N, columns)."""
        return self._sum(inputs, member) * self.scale + self.offset

    def mean(self, inputs: Tensor) -> Tensor:
        """Return the mean of the members' answers, (N, outputs), to inputs (N, columns)."""
        answers: Tensor = self(inputs)
        return answers.mean(dim=0)

    def held_out(self, inputs: Tensor, fold: Tensor) -> Tensor:
        """Return (N, outputs), each row of inputs (N, columns) by the member that did not learn from its fold (N,)."""
        answers: Tensor = self(inputs)
        return answers[fold, torch.arange(len(fold), device=fold.device)]

    def _sum(self, inputs: Tensor, member: int | None) -> Tensor:
        answers = []
        for group, perceptron in zip(self.groups, self.parts, strict=True):
            assert isinstance(perceptron, nn.ModuleList)
            values = inputs[..., group]
            if member is None:
                values = values.expand(self.members, *values.shape[-2:])
            for layer in perceptron[:-1]:
                values = torch.relu(layer(values, member))
            answers.append(perceptron[-1](values, member))
        total = answers[0]
        for answer in answers[1:]:
            total = total + answer
        return total


@dataclass(frozen=True)
class EnsembleTraining:
    """How an ensemble is trained: AdamW with torch's one-cycle schedule, on random rows.

    Attributes:
        learning_rate: the largest.
        weight_decay: AdamW's.
        warm_up: share of the steps over which the learning rate rises.
        batch_size: rows a step.
        steps: optimiser steps.
        many_rows: from so many rows on, those that follow hold.
        batch_size_of_many: rows a step.
        steps_of_many: optimiser steps.
    """

    learning_rate: float = 0.02
    weight_decay: float = 0.1
    warm_up: float = 0.1
    batch_size: int = 64
    steps: int = 2000
    many_rows: int = 12_000
    batch_size_of_many: int = 512
    steps_of_many: int = 2000


def learn(
    groups: Sequence[Sequence[int]],
    inputs: np.ndarray,
    outputs: np.ndarray,
    fold: np.ndarray,
    seed: int,
    weight: np.ndarray | None = None,
    training: EnsembleTraining | None = None,
    members: int | None = None,
) -> Ensemble:
    """Train one member a fold by least squares, each on all rows but those of its fold.

    Args:
        groups: the input columns that each part looks at.
        inputs: (N, columns), about 1 in size.
        outputs: (N, d).
        fold: (N,) numbers from 0, whole runs in a fold; −1 for rows that all members learn from.
        seed: of weights and batches.
        weight: (N, d) how much each number counts, or None.
        training: how; None: the defaults.
        members: how many; None: one a fold.
    """
    how = training or EnsembleTraining()
    many = len(inputs) >= how.many_rows
    batch, steps = (how.batch_size_of_many, how.steps_of_many) if many else (how.batch_size, how.steps)
    members = members or int(fold.max()) + 1
    generator = torch.Generator().manual_seed(seed)
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(seed)
        ensemble = Ensemble(members, groups, outputs.shape[1])
    given = torch.as_tensor(inputs, dtype=torch.float32)
    wanted = torch.as_tensor(outputs, dtype=torch.float32)
    ensemble.learn_scaling(wanted)
    wanted = (wanted - ensemble.offset) / ensemble.scale
    counts = torch.as_tensor(fold[None] != np.arange(members)[:, None], dtype=torch.float32)
    importance = torch.ones(len(given), 1) if weight is None else torch.as_tensor(weight, dtype=torch.float32)
    optimiser = torch.optim.AdamW(
        ensemble.parameters(), lr=how.learning_rate, weight_decay=how.weight_decay, fused=True
    )
    schedule = torch.optim.lr_scheduler.OneCycleLR(
        optimiser, how.learning_rate, total_steps=steps, pct_start=how.warm_up
    )
    for _ in range(steps):
        rows = torch.randint(0, len(given), (batch,), generator=generator)
        error = ((ensemble.scaled(given[rows]) - wanted[rows]) ** 2 * importance[rows]).mean(dim=-1)
        loss = members * (error * counts[:, rows]).sum() / counts[:, rows].sum()
        optimiser.zero_grad()
        loss.backward()
        optimiser.step()
        schedule.step()
    return ensemble.eval()


def bootstrap_counts(vehicle: np.ndarray, run: np.ndarray, members: int, seed: int) -> np.ndarray:
    """Say how often each row counts for each member, which learns from a resample of the runs of one vehicle.

    Runs are drawn with replacement, as many as there are: a bootstrap of clusters (Davison and Hinkley 1997, section
    3.8). Of several vehicles each member has one, in turn, so that members differ as vehicles do: resampled vehicles
    would make them differ as means over vehicles do, which is less. Where there are more vehicles than members, each
    member has a share of them.

    Args:
        vehicle: (N,) the vehicle of each row.
        run: (N,) the run of each row.
        members: M.
        seed: of what is drawn.

    Returns:
        (N, M) whole numbers.
    """
    rng = np.random.default_rng(seed)
    counts = np.zeros((len(run), members))
    shuffled = rng.permutation(np.unique(vehicle))
    for member in range(members):
        own = shuffled[member::members] if len(shuffled) > members else shuffled[[member % len(shuffled)]]
        rows = np.flatnonzero(np.isin(vehicle, own))
        tracks, of_track = np.unique(np.column_stack([vehicle, run])[rows], axis=0, return_inverse=True)
        times = rng.multinomial(len(tracks), np.full(len(tracks), 1 / len(tracks)))
        counts[rows, member] = times[of_track.ravel()]
    return counts


def folds_of(run: np.ndarray, count: int, split_runs: bool = False) -> np.ndarray:
    """Give each row a fold, whole runs in turn.

    Args:
        run: (N,) the run of each row.
        count: how many folds; with fewer runs there are as many folds as runs, unless
        split_runs: then folds are blocks of rows in time.

    Returns:
        (N,) numbers from 0.
    """
    runs, rank = np.unique(run, return_inverse=True)
    if split_runs and len(runs) < count:
        return np.arange(len(run)) * count // len(run)
    folds: np.ndarray = rank % min(count, len(runs))
    return folds
