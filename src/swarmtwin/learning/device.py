"""Where and how learning computes: on which device, on how many threads, from which random numbers."""

from collections.abc import Iterator
from contextlib import contextmanager
from typing import Literal

import torch
from threadpoolctl import threadpool_limits

from swarmtwin.errors import UserError

Device = Literal["auto", "cpu", "gpu"]
"""Where to compute: `gpu` wants a GPU (CUDA or ROCm), `auto` takes one where there is one."""


def torch_device(device: Device) -> torch.device:
    """Return the device that the configuration's word means on this machine.

    Raises:
        UserError: a GPU is asked for, and torch finds none.
    """
    if device == "cpu" or (device == "auto" and not torch.cuda.is_available()):
        return torch.device("cpu")
    if not torch.cuda.is_available():
        raise UserError("device: gpu is asked for, but torch finds none here: take device=cpu or device=auto")
    return torch.device("cuda", torch.cuda.current_device())


@contextmanager
def one_thread() -> Iterator[None]:
    """Let torch and numpy compute on one thread: the same numbers every time, and quicker on what is as small as here.

    Threads that wait for one another in OpenBLAS can make eigenvalues of a few hundred columns take 30 times as long.
    """
    threads = torch.get_num_threads()
    torch.set_num_threads(1)
    try:
        with threadpool_limits(1, user_api="blas"):
            yield
    finally:
        torch.set_num_threads(threads)


@contextmanager
def reproducible(seed: int, device: Device = "cpu") -> Iterator[None]:
    """Compute on one thread, from the random numbers of a seed; afterwards the caller's go on as if nothing had been.

    Args:
        seed: of torch's random numbers.
        device: where else than on the CPU random numbers are drawn.
    """
    chosen = torch_device(device)
    with one_thread(), torch.random.fork_rng(devices=[chosen] if chosen.type == "cuda" else []):
        torch.manual_seed(seed)
        yield
