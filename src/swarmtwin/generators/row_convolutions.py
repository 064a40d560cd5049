"""Convolutions over a row's columns in their order, as image networks have them over pixels."""

from itertools import pairwise
from typing import Literal

import torch
from torch import Tensor, nn


class Deconvolutions(nn.Module):
    """Maps (N, channels[0] · smallest length) to rows (N, width): each deconvolution doubles the length.

    Strided transposed convolutions with batch normalisation and ReLU, none of either at the end but tanh (Radford et
    al. 2015). The length is the least that can be halved as often as there are channels; columns beyond `width` are
    cut off.

    Attributes:
        start: channels and length at the start.
    """

    def __init__(self, channels: tuple[int, ...], width: int) -> None:
        super().__init__()
        self.width = width
        self.start = channels[0], smallest_length(channels, width)
        layers: list[nn.Module] = [nn.BatchNorm1d(channels[0]), nn.ReLU()]
        for pair in pairwise((*channels, 1)):
            layers += [
                nn.ConvTranspose1d(*pair, kernel_size=4, stride=2, padding=1),
                nn.BatchNorm1d(pair[1]),
                nn.ReLU(),
            ]
        self.layers = nn.Sequential(*layers[:-2], nn.Tanh())

    def forward(self, features: Tensor) -> Tensor:
        """Return rows (N, width) in −1…1."""
        rows: Tensor = self.layers(features.unflatten(1, self.start))
        return rows[:, 0, : self.width]


class Convolutions(nn.Module):
    """Maps rows (N, width) to features (N, channels[-1] · smallest length): each convolution halves the length.

    Convolutions with batch normalisation, but for the first, and LeakyReLU of slope 0.2 (Radford et al. 2015), strided
    or followed by average pooling. Rows are filled up with zeros.
    """

    def __init__(self, channels: tuple[int, ...], width: int, halved_by: Literal["stride", "pooling"]) -> None:
        super().__init__()
        self.missing = smallest_length(channels, width) * 2 ** len(channels) - width
        layers: list[nn.Module] = []
        for number, pair in enumerate(pairwise((1, *channels))):
            strided = halved_by == "stride"
            layers.append(nn.Conv1d(*pair, kernel_size=4 if strided else 3, stride=2 if strided else 1, padding=1))
            layers += [nn.BatchNorm1d(pair[1])] if number else []
            layers += [nn.LeakyReLU(0.2)] if strided else [nn.LeakyReLU(0.2), nn.AvgPool1d(2)]
        self.layers = nn.Sequential(*layers, nn.Flatten())

    def forward(self, rows: Tensor) -> Tensor:
        """Return features."""
        features: Tensor = self.layers(nn.functional.pad(rows, (0, self.missing))[:, None])
        return features


def smallest_length(channels: tuple[int, ...], width: int) -> int:
    """Return the length that doubled as often as there are channels is the least that `width` columns fit in."""
    return -(-width // 2 ** len(channels))


def start_small(network: nn.Module, sd: float = 0.02) -> nn.Module:
    """Start a network's weights as Radford et al. (2015) do: normal, of a small standard deviation."""
    for layer in network.modules():
        if isinstance(layer, nn.Linear | nn.Conv1d | nn.ConvTranspose1d):
            torch.nn.init.normal_(layer.weight, 0, sd)
    return network
