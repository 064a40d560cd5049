"""Exact integration of a constant velocity in the vehicle's frame, and its inverse, with gradients."""

import math

import torch
from torch import Tensor


def integrate_twist(forward_mm_s: Tensor, left_mm_s: Tensor, turn_rad_s: Tensor, duration_s: float) -> Tensor:
    """Return the displacements (N, 3) after `duration_s` at constant velocities (N,): arcs of circles."""
    turn_rad = turn_rad_s * duration_s
    along, across = _arc(turn_rad)
    forward_mm = (along * forward_mm_s - across * left_mm_s) * duration_s
    left_mm = (across * forward_mm_s + along * left_mm_s) * duration_s
    return torch.stack([forward_mm, left_mm, turn_rad], dim=-1)


def displacement_of(twist: Tensor) -> Tensor:
    """Return the displacements (..., 3) of the ways (..., 3) along arcs: the exponential map of SE(2)."""
    return integrate_twist(twist[..., 0], twist[..., 1], twist[..., 2], 1.0)


def twist_of(displacement: Tensor) -> Tensor:
    """Return the ways (..., 3) mm, mm, rad along the arcs that lead to displacements (..., 3): the logarithm of SE(2).

    The turn must be less than a full one.
    """
    along, across = _arc(displacement[..., 2])
    size = along**2 + across**2
    forward_mm = (along * displacement[..., 0] + across * displacement[..., 1]) / size
    left_mm = (along * displacement[..., 1] - across * displacement[..., 0]) / size
    return torch.stack([forward_mm, left_mm, displacement[..., 2]], dim=-1)


def _arc(turn_rad: Tensor) -> tuple[Tensor, Tensor]:
    """Return how far an arc of length 1 that turns by `turn_rad` leads ahead and to the left."""
    along = torch.sinc(turn_rad / math.pi)
    across = torch.sinc(turn_rad / (2 * math.pi)) * torch.sin(turn_rad / 2)
    return along, across
