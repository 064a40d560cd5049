"""Everything that a training continues from, in one file in which nothing executable can hide."""

import io
import logging
from pathlib import Path
from typing import Any, cast

import numpy as np
import torch
from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.buffers import ReplayBuffer
from stable_baselines3.common.off_policy_algorithm import OffPolicyAlgorithm

from swarmtwin.files import whole_file
from swarmtwin.policies.chances import read_chances, restore_chances
from swarmtwin.world.motion import SimulatedMotion
from swarmtwin.world.world import World

log = logging.getLogger(__name__)

REMEMBERED = ("observations", "next_observations", "actions", "rewards", "dones", "timeouts")
State = dict[str, Any]


def write_checkpoint(path: Path, state: State) -> None:
    """Write a state whole or not at all, replacing what `path` held."""
    content = io.BytesIO()  # a full disk is an OSError to Python, and none to torch
    torch.save(state, content)
    with whole_file(path) as aside:
        aside.write_bytes(content.getbuffer())


def read_checkpoint(path: Path | None, identity: str, seed: int) -> State:
    """Return a checkpoint's state; nothing if there is none, or if it is damaged or of another training."""
    if path is None or not path.exists():
        return {}
    try:
        state = cast(State, torch.load(path, weights_only=True))
    except Exception as error:  # torch.load raises many kinds for a damaged file
        reason = str(error).splitlines()[0]
        log.warning("seed %d starts anew: checkpoint %s is damaged (%s)", seed, path, reason)
        return {}
    if not isinstance(state, dict) or state.get("identity") != identity:
        log.warning("seed %d starts anew: checkpoint %s is of another training", seed, path)
        return {}
    return state


def algorithm_state(algorithm: BaseAlgorithm) -> State:
    """Return what an algorithm continues from: networks, optimisers, memory, counters, chances, what it saw last."""
    parameters = algorithm.get_parameters()
    _, variables = algorithm._get_torch_save_params()
    state = {
        "parameters": parameters,
        "variables": {name: getattr(algorithm, name).detach() for name in variables if _is_tensor(algorithm, name)},
        "num_timesteps": algorithm.num_timesteps,
        "updates": getattr(algorithm, "_n_updates", 0),
        "last_observation": torch.from_numpy(np.array(algorithm._last_obs)),
        "last_starts": torch.from_numpy(np.array(algorithm._last_episode_starts)),
        "chances": read_chances(algorithm),
    }
    if isinstance(algorithm, OffPolicyAlgorithm):
        assert algorithm.replay_buffer is not None
        state["memory"] = _memory_state(algorithm.replay_buffer)
    return state


def restore_algorithm(algorithm: BaseAlgorithm, state: State) -> None:
    """Let an untrained algorithm of the same configuration continue from a state."""
    algorithm.set_parameters(state["parameters"])
    for name, value in state["variables"].items():
        getattr(algorithm, name).data.copy_(value)
    algorithm.num_timesteps = state["num_timesteps"]
    algorithm._n_updates = state["updates"]
    algorithm._last_obs = state["last_observation"].numpy()
    algorithm._last_episode_starts = state["last_starts"].numpy()
    if isinstance(algorithm, OffPolicyAlgorithm):
        assert algorithm.replay_buffer is not None
        _restore_memory(algorithm.replay_buffer, state["memory"])
    restore_chances(algorithm, state["chances"])


def world_state(world: World) -> State:
    """Return what a simulated world continues from."""
    motion = cast(SimulatedMotion, world.motion)
    return {"world": _packed(world.state()), "motion": _packed(motion.state())}


def restore_world(world: World, state: State) -> None:
    """Let a simulated world of the same size continue from a state."""
    cast(SimulatedMotion, world.motion).restore(_unpacked(state["motion"]))
    world.restore(_unpacked(state["world"]))


def _is_tensor(algorithm: BaseAlgorithm, name: str) -> bool:
    return isinstance(getattr(algorithm, name, None), torch.Tensor)


def _memory_state(memory: ReplayBuffer) -> State:
    filled = memory.buffer_size if memory.full else memory.pos
    arrays = {name: torch.from_numpy(getattr(memory, name)[:filled]) for name in REMEMBERED}
    return {"position": memory.pos, "full": memory.full, **arrays}


def _restore_memory(memory: ReplayBuffer, state: State) -> None:
    memory.pos, memory.full = state["position"], state["full"]
    for name in REMEMBERED:
        getattr(memory, name)[: len(state[name])] = state[name].numpy()


def _packed(arrays: dict[str, np.ndarray]) -> State:
    return {name: str(array) if array.dtype.kind == "U" else torch.from_numpy(array) for name, array in arrays.items()}


def _unpacked(state: State) -> dict[str, np.ndarray]:
    return {name: np.array(part) if isinstance(part, str) else part.numpy() for name, part in state.items()}
