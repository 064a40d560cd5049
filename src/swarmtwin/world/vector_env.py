"""Many worlds as one gymnasium vector environment: every vehicle of every world is one sub-environment.

So one policy is learned from the experience of all vehicles (parameter sharing, section 4.5), and nothing loops over
them.
"""

from typing import Any

import numpy as np
from gymnasium.vector import AutoresetMode, VectorEnv
from gymnasium.vector.utils import batch_space

from swarmtwin.simulation.displacement_table import TableSettings
from swarmtwin.world.interface import Moved, command_space, commands_of, observation_space, open_world
from swarmtwin.world.task import Task
from swarmtwin.world.world import Step, World

Infos = dict[str, Any]


def vector_env(
    task: Task | str,
    motion: Moved,
    worlds: int = 1,
    seed: int = 0,
    compiled: bool = True,
    table: TableSettings | None = None,
) -> "SwarmVectorEnv":
    """Return the environment of a task in W worlds side by side, whose W · K vehicles are moved by `motion`.

    The arguments are those of `open_world`; here compiled code is taken unless asked not.

    Raises:
        UserError: see `open_world`.
    """
    return SwarmVectorEnv(open_world(task, motion, worlds, seed, compiled, table))


class SwarmVectorEnv(VectorEnv[np.ndarray, np.ndarray, np.ndarray]):
    """W · K sub-environments, the vehicles of one world after those of the one before; actions are commands.

    A world whose roll-out ends starts anew in the same step (`AutoresetMode.SAME_STEP`), all its vehicles together.
    `infos` has an array (W · K,) for each of `collided`, `left_arena`, `at_target` and `reached`, and beside each, as
    `_collided`, ..., the mask of those it says something about. Those whose roll-out has ended stand in `final_info`
    instead, and `final_obs` (W · K, o) is what each vehicle observed before any world started anew.

    Attributes:
        world: where the vehicles are.
    """

    def __init__(self, world: World) -> None:
        self.world = world
        self.num_envs = world.worlds * world.task.vehicles
        self.metadata = {"autoreset_mode": AutoresetMode.SAME_STEP, "render_modes": []}
        self.single_observation_space = observation_space(world.task)
        self.single_action_space = command_space(world.robot)
        self.observation_space = batch_space(self.single_observation_space, self.num_envs)
        self.action_space = batch_space(self.single_action_space, self.num_envs)

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[np.ndarray, Infos]:
        """Start all worlds in new scenarios; `seed` decides them and the ones after them. There are no `options`."""
        super().reset(seed=seed)
        if seed is not None:
            self.world.reseed(seed)
        return self._flat(self.world.reset()), {}

    def step(self, actions: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray, Infos]:
        """Hold the commands (W · K, m) for one control period.

        Raises:
            UserError: one is not finite, or they are of another shape.
        """
        robot = self.world.robot
        command = commands_of(actions, (self.num_envs, len(robot.command)), robot)
        step = self.world.step(command.reshape(self.world.shape))
        last = self._flat(step.observation.copy() if step.ended.any() else step.observation)
        observation = self._flat(self.world.restart(step.ended, step.observation))
        terminated, truncated = self._of_vehicles(step.terminated), self._of_vehicles(step.truncated)
        return observation, step.reward.reshape(-1), terminated, truncated, self._infos(step, last)

    def _infos(self, step: Step, last: np.ndarray) -> Infos:
        """Return what the period brought; `last` is what was observed at its end, (W · K, o)."""
        told = {
            "collided": step.events.collided.reshape(-1),
            "left_arena": step.events.left_arena.reshape(-1),
            "at_target": step.events.at_target.reshape(-1),
            "reached": self._of_vehicles(step.reached),
        }
        ended = self._of_vehicles(step.ended)
        if not ended.any():
            return _with_masks(told, ~ended)
        final = {"final_obs": last, "_final_obs": ended, "final_info": _with_masks(told, ended), "_final_info": ended}
        return _with_masks(told, ~ended) | final

    def _flat(self, observation: np.ndarray) -> np.ndarray:
        return observation.reshape(self.num_envs, -1)

    def _of_vehicles(self, of_worlds: np.ndarray) -> np.ndarray:
        """Return what is true of worlds (W,) for each of their vehicles, (W · K,)."""
        return np.repeat(of_worlds, self.world.task.vehicles)


def _with_masks(told: Infos, rows: np.ndarray) -> Infos:
    """Return arrays (N,) with a mask beside each that says in which rows they count; elsewhere they are False."""
    return {name: values & rows for name, values in told.items()} | {f"_{name}": rows.copy() for name in told}
