"""Whether tensors can be passed over by compiled code: asked without loading what compiles it."""

from functools import cache
from importlib.util import find_spec

import torch
from torch import Tensor


def can_pass_over(*given: Tensor) -> bool:
    """Say whether tables (N, k) lie on a CPU in double precision, need no gradient, and numba is installed."""
    is_plain = all(
        one.dtype == torch.float64 and one.is_cpu and not one.requires_grad and one.ndim == 2 for one in given
    )
    return is_plain and can_compile()


@cache
def can_compile() -> bool:
    """Say whether numba is installed."""
    return find_spec("numba") is not None
