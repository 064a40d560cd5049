"""Worlds for a training loop of one's own: tensors in, tensors out, on any device."""

from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor

from swarmtwin.simulation.displacement_table import TableSettings
from swarmtwin.world.interface import Moved, commands_of, open_world
from swarmtwin.world.task import Task
from swarmtwin.world.world import World


class TorchStep(NamedTuple):
    """What one control period brought, in W worlds of K vehicles.

    Attributes:
        observation: (W, K, o) float32 at its end; where a roll-out ended, that of its last moment.
        reward: (W, K) float32; 0 where the roll-out had ended before.
        terminated: (W,) whether the task ended early, in this period.
        truncated: (W,) whether the time ran out or a vehicle was lost, in this period.
    """

    observation: Tensor
    reward: Tensor
    terminated: Tensor
    truncated: Tensor

    @property
    def ended(self) -> Tensor:
        """Whether the roll-out of a world ended in this period, (W,)."""
        return self.terminated | self.truncated


def torch_world(
    task: Task | str,
    motion: Moved,
    worlds: int = 1,
    seed: int = 0,
    device: torch.device | str = "cpu",
    compiled: bool = True,
    table: TableSettings | None = None,
) -> "TorchWorld":
    """Return the W worlds of a task, whose vehicles are moved by `motion`.

    The arguments are those of `open_world`; here compiled code is taken unless asked not. `device` says where the
    tensors lie that are returned; the simulation computes wherever it lies itself.

    Raises:
        UserError: see `open_world`.
    """
    return TorchWorld(open_world(task, motion, worlds, seed, compiled, table), device)


class TorchWorld:
    """A `World` that speaks in tensors; those that lie on the CPU share the memory of its arrays.

    Training is `reset`, then `step` and `restart(step.ended)` in turn; a roll-out that has ended stands still until it
    is restarted.

    Attributes:
        world: what is stepped.
        device: where the tensors lie that are returned.
    """

    def __init__(self, world: World, device: torch.device | str = "cpu") -> None:
        self.world = world
        self.device = torch.device(device)

    def reset(self, seed: int | None = None) -> Tensor:
        """Start every world in a new scenario, drawn with `seed` if one is given; return the observation (W, K, o)."""
        if seed is not None:
            self.world.reseed(seed)
        return self._tensor(self.world.reset())

    def restart(self, worlds: Tensor, observation: Tensor | None = None) -> Tensor:
        """Start the worlds of a mask (W,) in new scenarios, leave the others; return the observation (W, K, o).

        Where the last step's observation is given, on the CPU, it is only written over where worlds start anew.
        """
        shared = None if observation is None or observation.is_cuda else observation.numpy()
        return self._tensor(self.world.restart(worlds.cpu().numpy(), shared))

    def step(self, command: Tensor) -> TorchStep:
        """Hold commands (W, K, m), in the robot's units, for one period; those beyond the limits are cut to them.

        Raises:
            UserError: a command is not finite, or they are of another shape.
        """
        given = commands_of(torch.as_tensor(command).detach().cpu(), self.world.shape, self.world.robot, "commands")
        step = self.world.step(given)
        return TorchStep(
            self._tensor(step.observation),
            self._tensor(step.reward.astype(np.float32)),
            self._tensor(step.terminated),
            self._tensor(step.truncated),
        )

    def _tensor(self, array: np.ndarray) -> Tensor:
        return torch.from_numpy(array).to(self.device)
