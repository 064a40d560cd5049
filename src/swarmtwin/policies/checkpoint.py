"""Everything that a training continues from, in one file in which nothing executable can hide."""

import io
import json
import logging
import random
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any, cast

import numpy as np
import torch
from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.buffers import ReplayBuffer
from stable_baselines3.common.off_policy_algorithm import OffPolicyAlgorithm
from stable_baselines3.common.save_util import load_from_zip_file

from swarmtwin.files import whole_file

log = logging.getLogger(__name__)

Content = dict[str, Any]
"""Plain values, tensors, and dictionaries of them: what `torch.load` reads without executing anything."""


def write_checkpoint(path: Path, content: Content) -> None:
    """Write a checkpoint whole or not at all, replacing what `path` held."""
    written = io.BytesIO()  # a full disk is an OSError to Python, and none to torch
    torch.save(content, written)
    with whole_file(path) as aside:
        aside.write_bytes(written.getbuffer())


def read_checkpoint(path: Path | None, identity: str, seed: int) -> Content:
    """Return a checkpoint's content; nothing if there is none, or if it is damaged or of another training."""
    if path is None or not path.exists():
        return {}
    try:
        content = cast(Content, torch.load(path, weights_only=True))
    except Exception as error:  # torch.load raises many kinds for a damaged file
        reason = str(error).splitlines()[0]
        log.warning("seed %d starts anew: checkpoint %s is damaged (%s)", seed, path, reason)
        return {}
    if not isinstance(content, dict) or content.get("identity") != identity:
        log.warning("seed %d starts anew: checkpoint %s is of another training", seed, path)
        return {}
    return content


def algorithm_state(algorithm: BaseAlgorithm) -> Content:
    """Return what an algorithm continues from: networks and optimisers, counters, replay buffer, random numbers.

    Networks and optimisers are saved by stable-baselines3 itself; all else that it would save, it would pickle.
    Counters are all of its plain numbers, private ones too: TD3 delays its actor by `_n_updates`, which has no public
    name, and an algorithm of one's own may count more.
    """
    networks = io.BytesIO()
    algorithm.save(networks, exclude=list(vars(algorithm)))
    state: Content = {
        "networks": torch.frombuffer(bytearray(networks.getvalue()), dtype=torch.uint8),
        "counters": {name: value for name, value in vars(algorithm).items() if type(value) in (bool, int, float)},
        "random": _rng_state(algorithm),
    }
    if isinstance(algorithm, OffPolicyAlgorithm):
        assert algorithm.replay_buffer is not None
        state["replay_buffer"] = _replay_buffer_state(algorithm.replay_buffer)
    return state


def restore_algorithm(algorithm: BaseAlgorithm, state: Content) -> None:
    """Let an untrained algorithm of the same configuration continue from a state."""
    networks = io.BytesIO(state["networks"].numpy().tobytes())
    _, parameters, variables = load_from_zip_file(networks, load_data=False, device=algorithm.device)
    algorithm.set_parameters(parameters, device=algorithm.device)
    for name, value in (variables or {}).items():
        getattr(algorithm, name).data.copy_(value)
    vars(algorithm).update(state["counters"])
    if isinstance(algorithm, OffPolicyAlgorithm):
        assert algorithm.replay_buffer is not None
        _restore_replay_buffer(algorithm.replay_buffer, state["replay_buffer"])
    _restore_rng(algorithm, state["random"])


def pack(arrays: dict[str, np.ndarray]) -> Content:
    """Return arrays of numbers or of one text as tensors and texts, for a checkpoint."""
    return {name: str(array) if array.dtype.kind == "U" else torch.from_numpy(array) for name, array in arrays.items()}


def unpack(content: Content) -> dict[str, np.ndarray]:
    """Return the arrays that were packed."""
    return {name: np.array(part) if isinstance(part, str) else part.numpy() for name, part in content.items()}


@contextmanager
def global_rng_kept() -> Iterator[None]:
    """Leave the global random states of Python, numpy and torch, which stable-baselines3 draws from, as they were."""
    python_state, numpy_state = random.getstate(), np.random.get_state()  # noqa: NPY002 — what the library draws from
    with torch.random.fork_rng(devices=range(torch.cuda.device_count())):
        try:
            yield
        finally:
            random.setstate(python_state)
            np.random.set_state(numpy_state)  # noqa: NPY002


def _rng_state(algorithm: BaseAlgorithm) -> Content:
    """Return the states of all random numbers that an algorithm draws."""
    return {
        "torch": torch.get_rng_state(),
        "cuda": torch.cuda.get_rng_state_all(),
        "numpy": json.dumps(np.random.get_state(legacy=False), default=np.ndarray.tolist),  # noqa: NPY002
        "actions": json.dumps(algorithm.action_space.np_random.bit_generator.state),
    }


def _restore_rng(algorithm: BaseAlgorithm, state: Content) -> None:
    torch.set_rng_state(state["torch"])
    torch.cuda.set_rng_state_all(state["cuda"])
    np.random.set_state(json.loads(state["numpy"]))  # noqa: NPY002
    algorithm.action_space.np_random.bit_generator.state = json.loads(state["actions"])


def _replay_buffer_state(memory: ReplayBuffer) -> Content:
    arrays = {name: array for name, array in vars(memory).items() if isinstance(array, np.ndarray)}
    filled = memory.buffer_size if memory.full else memory.pos
    return {
        "position": memory.pos,
        "full": memory.full,
        "arrays": {name: torch.from_numpy(array[:filled]) for name, array in arrays.items()},
    }


def _restore_replay_buffer(memory: ReplayBuffer, state: Content) -> None:
    memory.pos, memory.full = state["position"], state["full"]
    for name, array in state["arrays"].items():
        getattr(memory, name)[: len(array)] = array.numpy()
