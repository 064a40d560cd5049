"""One world as a PettingZoo parallel environment, for any library that speaks it."""

from typing import Any

import numpy as np
from gymnasium.spaces import Box
from pettingzoo import ParallelEnv

from swarmtwin.world.interface import (
    Moved,
    command_space,
    commands_of,
    observation_space,
    open_world,
    vehicle_info,
)
from swarmtwin.world.rendering.live_frame import LiveFrame
from swarmtwin.world.task import Task
from swarmtwin.world.world import World

Observations = dict[str, np.ndarray]
Infos = dict[str, dict[str, Any]]


def parallel_env(task: Task | str, motion: Moved, seed: int = 0, render_mode: str | None = None) -> "SwarmEnv":
    """Return the environment of a task whose vehicles are moved by `motion`.

    Args:
        task: what the vehicles are asked to do, or the name of a file in `conf/task/`.
        motion: what moves them, of one world; or a simulation; or a model's folder, as train or a diagnosis leaves it.
        seed: of the scenarios.
        render_mode: `rgb_array`, or None: no pictures.

    Raises:
        UserError: there is no such task, model or render mode, or the motion is of another robot.
    """
    return SwarmEnv(open_world(task, motion, seed=seed), render_mode)


class SwarmEnv(ParallelEnv[str, np.ndarray, np.ndarray]):
    """Agents `vehicle_0` … `vehicle_<K − 1>`; an action is a command in the robot's units.

    `infos` says of each vehicle whether it `collided`, `left_arena` or is `at_target`, and whether the group has
    `reached` all targets. All vehicles end together.
    """

    metadata: dict[str, Any]
    render_mode: str | None

    def __init__(self, world: World, render_mode: str | None) -> None:
        self._live = LiveFrame(world, render_mode)
        name = f"swarmtwin_{world.task.config.name}"
        self.metadata = {"name": name, "is_parallelizable": True, **self._live.metadata}
        self.render_mode = render_mode
        self.world = world
        self.possible_agents = [f"vehicle_{index}" for index in range(world.task.vehicles)]
        self.agents = list(self.possible_agents)
        self.observation_spaces = {agent: observation_space(world.task) for agent in self.possible_agents}
        self.action_spaces = {agent: command_space(world.robot) for agent in self.possible_agents}

    def observation_space(self, agent: str) -> Box:
        """Return the space of an agent's observations."""
        return self.observation_spaces[agent]

    def action_space(self, agent: str) -> Box:
        """Return the space of an agent's commands: within the robot's limits."""
        return self.action_spaces[agent]

    def reset(self, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[Observations, Infos]:
        """Start in a new scenario; `seed` decides it and the ones after it. There are no `options`."""
        if seed is not None:
            self.world.reseed(seed)
        observation = self.world.reset()[0]
        self.agents = list(self.possible_agents)
        self._live.restart()
        return self._by_agent(observation), {agent: {} for agent in self.agents}

    def step(
        self, actions: dict[str, np.ndarray]
    ) -> tuple[Observations, dict[str, float], dict[str, bool], dict[str, bool], Infos]:
        """Hold each agent's command for one control period.

        Raises:
            UserError: a command is not finite, or of another shape than the agent's space.
            ValueError: an agent has no command, or the roll-out is over.
        """
        if not self.agents:
            raise ValueError("all vehicles have ended: reset the environment")
        if absent := set(self.agents) - set(actions):
            raise ValueError(f"no action for {', '.join(sorted(absent))}")
        robot, agents = self.world.robot, self.agents
        commands = [commands_of(actions[agent], (len(robot.command),), robot, agent) for agent in agents]
        step = self.world.step(np.stack(commands)[None])
        self._live.follow(step)
        rewards = {agent: float(reward) for agent, reward in zip(agents, step.reward[0], strict=True)}
        infos = {agent: vehicle_info(step, index) for index, agent in enumerate(agents)}
        observations = self._by_agent(step.observation[0])
        if step.ended[0]:
            self.agents = []
        terminated = dict.fromkeys(agents, bool(step.terminated[0]))
        return observations, rewards, terminated, dict.fromkeys(agents, bool(step.truncated[0])), infos

    def render(self) -> np.ndarray | None:
        """Return a picture (height, width, 3) of the world now, where the render mode asks for one."""
        return self._live.picture()

    def close(self) -> None:
        """Nothing is held open."""

    def _by_agent(self, observation: np.ndarray) -> Observations:
        return dict(zip(self.agents, observation, strict=True))
