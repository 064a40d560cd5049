"""Motion along arcs of circles: where vehicles come to that hold a twist, and which twist leads somewhere.

On a CPU, in double precision and where no gradient is asked for, each is computed in one pass, the same to rounding, if
numba is installed.
"""

import torch
from torch import Tensor

from swarmtwin import geometry
from swarmtwin.compilable import can_pass_over
from swarmtwin.geometry import compose, displacement_between


def moved_along(pose: Tensor, twist: Tensor, share: float = 1.0) -> Tensor:
    """Return the poses (N, 3) that twists (N, 3) lead to from `pose` (N, 3), held for a share of a period.

    It is `compose(pose, exp_map(twist * share))`.
    """
    if can_pass_over(pose, twist) and pose.shape == twist.shape:
        from swarmtwin.simulation import compiled_arcs

        return torch.from_numpy(compiled_arcs.moved_along(*(one.contiguous().numpy() for one in (pose, twist)), share))
    return compose(pose, geometry.exp_map(twist * share))


def twist_between(start: Tensor, end: Tensor) -> Tensor:
    """Return the twists (N, 3) that lead from poses (N, 3) to others in a period: `log_map(displacement_between(…))`.

    They turn by half a circle at most.
    """
    if can_pass_over(start, end) and start.shape == end.shape:
        from swarmtwin.simulation import compiled_arcs

        return torch.from_numpy(compiled_arcs.twist_between(*(one.contiguous().numpy() for one in (start, end))))
    return geometry.log_map(displacement_between(start, end))


def exp_map(twist: Tensor) -> Tensor:
    """Return the displacements (N, 3) of twists (N, 3) per period, as `geometry.exp_map`."""
    if can_pass_over(twist):
        from swarmtwin.simulation import compiled_arcs

        return torch.from_numpy(compiled_arcs.displacement_along(twist.contiguous().numpy()))
    return geometry.exp_map(twist)


def log_map(displacement: Tensor) -> Tensor:
    """Return the twists (N, 3) per period that lead to displacements (N, 3), as `geometry.log_map`."""
    if can_pass_over(displacement):
        from swarmtwin.simulation import compiled_arcs

        return torch.from_numpy(compiled_arcs.twist_along(displacement.contiguous().numpy()))
    return geometry.log_map(displacement)
