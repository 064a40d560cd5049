"""Motion along arcs of circles: where vehicles come to that hold a twist."""

import math

import numpy as np
import torch
from torch import Tensor

from swarmtwin.compiled import compiled
from swarmtwin.geometry import compose, exp_map


def moved_along(pose: Tensor, twist: Tensor, share: float = 1.0) -> Tensor:
    """Return the poses (N, 3) that twists (N, 3) lead to from `pose` (N, 3), held for a share of a period.

    It is `compose(pose, exp_map(twist * share))`. On a CPU, in double precision and where no gradient is asked for,
    that is computed in one pass, the same to rounding.
    """
    both = (pose, twist)
    if all(one.dtype == torch.float64 and one.is_cpu and not one.requires_grad and one.ndim == 2 for one in both):
        return torch.from_numpy(_moved_along(*(one.contiguous().numpy() for one in both), share))
    return compose(pose, exp_map(twist * share))


@compiled
def _moved_along(pose: np.ndarray, twist: np.ndarray, share: float) -> np.ndarray:
    """Return what `moved_along` says, by the chords of arcs, which point where the vehicle heads halfway."""
    moved = np.empty_like(pose)
    for row in range(len(pose)):
        half = 0.5 * share * twist[row, 2]
        chord = share * (math.sin(half) / half if half != 0.0 else 1.0)
        along, across = chord * math.cos(pose[row, 2] + half), chord * math.sin(pose[row, 2] + half)
        moved[row, 0] = pose[row, 0] + along * twist[row, 0] - across * twist[row, 1]
        moved[row, 1] = pose[row, 1] + across * twist[row, 0] + along * twist[row, 1]
        heading = pose[row, 2] + 2 * half
        if heading > math.pi or heading <= -math.pi:
            heading -= 2 * math.pi * math.ceil((heading - math.pi) / (2 * math.pi))
        moved[row, 2] = heading
    return moved
