"""Exact integration of a constant velocity in the vehicle's frame, with gradients."""

import math

import torch
from torch import Tensor


def integrate_twist(forward_mm_s: Tensor, left_mm_s: Tensor, turn_rad_s: Tensor, duration_s: float) -> Tensor:
    """Return the displacements (N, 3) after `duration_s` at constant velocities (N,): arcs of circles."""
    turn_rad = turn_rad_s * duration_s
    along = torch.sinc(turn_rad / math.pi) * duration_s
    across = torch.sinc(turn_rad / (2 * math.pi)) * torch.sin(turn_rad / 2) * duration_s
    forward_mm = along * forward_mm_s - across * left_mm_s
    left_mm = across * forward_mm_s + along * left_mm_s
    return torch.stack([forward_mm, left_mm, turn_rad], dim=-1)
