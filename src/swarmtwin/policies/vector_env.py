"""The simulated world as stable-baselines3 wants it: every vehicle of every world is one sub-environment.

So one policy is learned from the experience of all vehicles (parameter sharing, section 4.5).
"""

from collections.abc import Sequence
from typing import Any

import numpy as np
from gymnasium.spaces import Box
from stable_baselines3.common.vec_env import VecEnv
from stable_baselines3.common.vec_env.base_vec_env import VecEnvIndices, VecEnvStepReturn

from swarmtwin.world.vector_env import SwarmVectorEnv
from swarmtwin.world.world import World


class DivergedError(Exception):
    """The algorithm asked for an action that is not finite."""


class SharedPolicyEnv(VecEnv):
    """W · K sub-environments; actions are shares −1…1 of the command's limits.

    Worlds start their next roll-out by themselves, so `begin` is called once, before training; the `reset` of
    stable-baselines3 only looks, and an interrupted training goes on where it was.

    Attributes:
        world: where the vehicles are.
        reward_scale: what rewards are divided by.
    """

    def __init__(self, world: World, reward_scale: float) -> None:
        self.world = world
        self.reward_scale = reward_scale
        self._vehicles = SwarmVectorEnv(world)
        columns = len(world.robot.command)
        super().__init__(
            self._vehicles.num_envs, self._vehicles.single_observation_space, Box(-1.0, 1.0, (columns,), np.float32)
        )
        self._low, self._high = world.robot.command_low, world.robot.command_high
        self._action = np.zeros((self.num_envs, columns))

    def begin(self) -> None:
        """Start all worlds, each as if another share of its time had passed, so that they do not all end at once."""
        self.world.reset()
        self.world.step_count[:] = np.arange(self.world.worlds) * self.world.task.steps // self.world.worlds

    def reset(self) -> np.ndarray:
        """Return what the vehicles observe now, (W · K, o); `begin` is what starts the worlds."""
        return self.world.observe().reshape(self.num_envs, -1)

    def step_async(self, actions: np.ndarray) -> None:
        """Take the vehicles' actions (W · K, m).

        Raises:
            DivergedError: one is not finite.
        """
        if not np.isfinite(actions).all():
            raise DivergedError
        self._action = actions

    def step_wait(self) -> VecEnvStepReturn:
        """Let one control period pass; worlds that ended start anew, their last observation stands in the infos."""
        share = 0.5 * (self._action.astype(float) + 1.0)
        command = self._low + (self._high - self._low) * share  # the world cuts what is beyond the limits
        observation, reward, terminated, truncated, told = self._vehicles.step(command)
        ended = terminated | truncated
        infos: list[dict[str, Any]] = [{}] * self.num_envs
        for row in np.flatnonzero(ended):
            infos[row] = {
                "terminal_observation": told["final_obs"][row],
                "TimeLimit.truncated": bool(truncated[row]),
            }
        return observation, (reward / self.reward_scale).astype(np.float32), ended, infos

    def close(self) -> None:
        """Nothing is held open."""

    def get_attr(self, attr_name: str, indices: VecEnvIndices = None) -> list[Any]:
        """Return an attribute of this object, once for each sub-environment."""
        return [getattr(self, attr_name, None) for _ in self._get_indices(indices)]

    def set_attr(self, attr_name: str, value: Any, indices: VecEnvIndices = None) -> None:
        """Refuse: sub-environments have no attributes of their own."""
        raise AttributeError("the sub-environments share one world and have nothing of their own")

    def env_method(
        self, method_name: str, *method_args: Any, indices: VecEnvIndices = None, **method_kwargs: Any
    ) -> list[Any]:
        """Refuse: sub-environments have no methods of their own."""
        raise AttributeError("the sub-environments share one world and have nothing of their own")

    def env_is_wrapped(self, wrapper_class: type, indices: VecEnvIndices = None) -> list[bool]:
        """Return that no sub-environment is wrapped."""
        return [False for _ in self._get_indices(indices)]

    def seed(self, seed: int | None = None) -> Sequence[int | None]:
        """Leave the world as it is: its own seed decides."""
        return [None] * self.num_envs
