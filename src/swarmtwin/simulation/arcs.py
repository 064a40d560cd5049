"""Motion along arcs of circles: where vehicles come to that hold a twist."""

from functools import cache
from importlib.util import find_spec

import torch
from torch import Tensor

from swarmtwin.geometry import compose, exp_map


def moved_along(pose: Tensor, twist: Tensor, share: float = 1.0) -> Tensor:
    """Return the poses (N, 3) that twists (N, 3) lead to from `pose` (N, 3), held for a share of a period.

    It is `compose(pose, exp_map(twist * share))`. On a CPU, in double precision and where no gradient is asked for,
    that is computed in one pass, the same to rounding, if numba is installed.
    """
    both = (pose, twist)
    is_plain = all(
        one.dtype == torch.float64 and one.is_cpu and not one.requires_grad and one.ndim == 2 for one in both
    )
    if is_plain and _can_compile():
        from swarmtwin.simulation import compiled_arcs

        return torch.from_numpy(compiled_arcs.moved_along(*(one.contiguous().numpy() for one in both), share))
    return compose(pose, exp_map(twist * share))


@cache
def _can_compile() -> bool:
    return find_spec("numba") is not None
