"""The global random numbers that stable-baselines3 draws from: borrowed for a training, and given back as they were."""

import random
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any, cast

import numpy as np
import torch
from stable_baselines3.common.base_class import BaseAlgorithm
from torch import Tensor

State = dict[str, Any]


@contextmanager
def borrowed_chances() -> Iterator[None]:
    """Leave the global random states of Python, numpy and torch as they were before the block."""
    python_state, numpy_state = random.getstate(), np.random.get_state()  # noqa: NPY002 — what the library draws from
    with torch.random.fork_rng(devices=[]):
        try:
            yield
        finally:
            random.setstate(python_state)
            np.random.set_state(numpy_state)  # noqa: NPY002


def read_chances(algorithm: BaseAlgorithm) -> State:
    """Return the states of all random numbers that an algorithm draws, as plain values and tensors."""
    kind, keys, position, has_gauss, gauss = cast(tuple[Any, ...], np.random.get_state())  # noqa: NPY002
    actions = algorithm.action_space.np_random.bit_generator.state
    return {
        "torch": torch.get_rng_state(),
        "numpy": (kind, torch.from_numpy(keys.astype(np.int64)), position, has_gauss, gauss),
        "actions": {name: str(value) for name, value in actions["state"].items()},
        "actions_half": (actions["has_uint32"], actions["uinteger"]),
    }


def restore_chances(algorithm: BaseAlgorithm, state: State) -> None:
    """Continue from states that `read_chances` returned."""
    torch.set_rng_state(cast(Tensor, state["torch"]))
    kind, keys, position, has_gauss, gauss = state["numpy"]
    np.random.set_state((kind, keys.numpy().astype(np.uint32), position, has_gauss, gauss))  # noqa: NPY002
    generator = algorithm.action_space.np_random.bit_generator
    has_uint32, uinteger = state["actions_half"]
    generator.state = {
        "bit_generator": "PCG64",
        "state": {name: int(value) for name, value in state["actions"].items()},
        "has_uint32": has_uint32,
        "uinteger": uinteger,
    }
