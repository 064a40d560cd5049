"""Layers that several of the published networks share."""

from collections.abc import Sequence
from itertools import pairwise

import torch
import torch.nn.functional as F
from torch import Tensor, nn


class PointwiseConvolution(nn.Module):
    """Conv1d(kernel 1, padding 1) → BatchNorm1d → LeakyReLU, on (channels, batch, length) → (…, length + 2).

    With the channels in front, the convolution is one matrix product and the normalisation runs over contiguous rows;
    the numbers are those of torch's layers on (batch, channels, length).
    """

    def __init__(self, channels_in: int, channels_out: int) -> None:
        super().__init__()
        self.convolution = nn.Linear(channels_in, channels_out)
        self.normalisation = nn.BatchNorm1d(channels_out)

    def forward(self, values: Tensor) -> Tensor:
        """Pad, mix the channels, normalise, bend."""
        padded = F.pad(values, (1, 1))
        mixed = torch.addmm(self.convolution.bias[:, None], self.convolution.weight, padded.flatten(1))
        normalised = self.normalisation(mixed[None])[0]
        return F.leaky_relu(normalised).view(-1, *padded.shape[1:])


def normalised_layers(widths: Sequence[int], activation: type[nn.Module]) -> nn.Sequential:
    """Stack Linear → BatchNorm → activation for each pair of `widths`."""
    layers: list[nn.Module] = []
    for inputs, outputs in pairwise(widths):
        layers += [nn.Linear(inputs, outputs), nn.BatchNorm1d(outputs), activation()]
    return nn.Sequential(*layers)


class RecurrentNetwork(nn.Module):
    """A recurrent layer that reads the inputs one by one → BatchNorm MLP on its last hidden state → Sigmoid."""

    def __init__(self, recurrence: nn.LSTM | nn.GRU, widths: Sequence[int]) -> None:
        super().__init__()
        self.recurrence = recurrence
        self.layers = normalised_layers((recurrence.hidden_size, *widths), nn.LeakyReLU)
        self.output = nn.Sequential(nn.Linear(widths[-1], 3), nn.Sigmoid())

    def forward(self, values: Tensor) -> Tensor:
        """Map inputs scaled to 0…1 (N, inputs) to displacements scaled to 0…1 (N, 3)."""
        sequence, _ = self.recurrence(values.T[..., None])
        scaled: Tensor = self.output(self.layers(sequence[-1]))
        return scaled
