"""One world as a PettingZoo parallel environment, for any library that speaks it."""

from pathlib import Path
from typing import Any

import numpy as np
from gymnasium.spaces import Box
from pettingzoo import ParallelEnv

from swarmtwin.configuration import config_files
from swarmtwin.errors import UserError, near_miss
from swarmtwin.plain_yaml import read_yaml
from swarmtwin.robot import Arena, Robot
from swarmtwin.simulation.simulation_folder import load_simulation
from swarmtwin.world.motion import Motion, SimulatedMotion
from swarmtwin.world.rendering.frame import Frame, Status
from swarmtwin.world.task import Task, task_config
from swarmtwin.world.world import Step, World

Observations = dict[str, np.ndarray]
Infos = dict[str, dict[str, Any]]


def parallel_env(
    task: Task | str, motion: Motion | Path | str, seed: int = 0, render_mode: str | None = None
) -> "SwarmEnv":
    """Return the environment of a task whose vehicles are moved by `motion`.

    Args:
        task: what the vehicles are asked to do, or the name of a file in `conf/task/`.
        motion: what moves them, of one world; or a model's folder, as train or a diagnosis leaves it.
        seed: of the scenarios.
        render_mode: `rgb_array`, or None: no pictures.

    Raises:
        UserError: there is no such task, model or render mode, or the motion is of another robot.
    """
    if not isinstance(motion, Path | str):
        return SwarmEnv(_built(task, motion.robot), motion, seed, render_mode)
    simulation = load_simulation(Path(motion))
    task = _built(task, simulation.robot, simulation.conditions.arena_mm)
    return SwarmEnv(task, SimulatedMotion(simulation, worlds=1, vehicles=task.vehicles), seed, render_mode)


def _built(task: Task | str, robot: Robot, arena: Arena | None = None) -> Task:
    if isinstance(task, Task):
        return task
    known = config_files("task")
    if task not in known:
        raise UserError(f"no such task: {task!r}: {near_miss(task, known)}")
    return task_config(read_yaml(known[task]), str(known[task])).build(robot, arena)


class SwarmEnv(ParallelEnv[str, np.ndarray, np.ndarray]):
    """Agents `vehicle_0` … `vehicle_<K − 1>`; an action is a command in the robot's units.

    `infos` says of each vehicle whether it `collided`, `left_arena` or is `at_target`, and whether the group has
    `reached` all targets. All vehicles end together.
    """

    metadata: dict[str, Any]
    render_mode: str | None

    def __init__(self, task: Task, motion: Motion, seed: int, render_mode: str | None) -> None:
        render_modes = ["rgb_array"]
        if render_mode is not None and render_mode not in render_modes:
            raise UserError(f"no such render mode: {render_mode!r}: {near_miss(render_mode, render_modes)}")
        robot = task.robot
        self.metadata = {
            "name": f"swarmtwin_{task.config.name}",
            "render_modes": render_modes,
            "render_fps": 1.0 / robot.period_s,
            "is_parallelizable": True,
        }
        self.render_mode = render_mode
        self.world = World(task, motion, worlds=1, seed=seed)
        self.possible_agents = [f"vehicle_{index}" for index in range(task.vehicles)]
        self.agents = list(self.possible_agents)
        self.observation_spaces = {
            agent: Box(-np.inf, np.inf, (task.observation_size,), np.float32) for agent in self.possible_agents
        }
        low, high = robot.command_low.astype(np.float32), robot.command_high.astype(np.float32)
        self.action_spaces = {agent: Box(low, high, dtype=np.float32) for agent in self.possible_agents}
        self._path = [self.world.pose[0]]
        self._colliding = np.zeros(task.vehicles, dtype=bool)
        self._collided = self._left_arena = False

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
        self._path = [self.world.pose[0]]
        self._colliding = np.zeros(len(self.agents), dtype=bool)
        self._collided = self._left_arena = False
        return self._by_agent(observation), {agent: {} for agent in self.agents}

    def step(
        self, actions: dict[str, np.ndarray]
    ) -> tuple[Observations, dict[str, float], dict[str, bool], dict[str, bool], Infos]:
        """Hold each agent's command for one control period.

        Raises:
            UserError: a command is not finite.
            ValueError: an agent has no command, or the roll-out is over.
        """
        if not self.agents:
            raise ValueError("all vehicles have ended: reset the environment")
        if absent := set(self.agents) - set(actions):
            raise ValueError(f"no action for {', '.join(sorted(absent))}")
        step = self.world.step(np.stack([actions[agent] for agent in self.agents])[None])
        self._remember(step)
        agents = self.agents
        rewards = {agent: float(reward) for agent, reward in zip(agents, step.reward[0], strict=True)}
        infos = {agent: self._info(step, index) for index, agent in enumerate(agents)}
        observations = self._by_agent(step.observation[0])
        if step.ended[0]:
            self.agents = []
        terminated = dict.fromkeys(agents, bool(step.terminated[0]))
        return observations, rewards, terminated, dict.fromkeys(agents, bool(step.truncated[0])), infos

    def render(self) -> np.ndarray | None:
        """Return a picture (height, width, 3) of the world now, where the render mode asks for one."""
        if self.render_mode is None:
            return None
        from swarmtwin.world.rendering.drawing import draw  # OpenCV, only for those who want pictures

        return draw(self._frame())

    def close(self) -> None:
        """Nothing is held open."""

    def _by_agent(self, observation: np.ndarray) -> Observations:
        return dict(zip(self.agents, observation, strict=True))

    def _info(self, step: Step, vehicle: int) -> dict[str, Any]:
        return {
            "collided": bool(step.events.collided[0, vehicle]),
            "left_arena": bool(step.events.left_arena[0, vehicle]),
            "at_target": bool(step.events.at_target[0, vehicle]),
            "reached": bool(step.reached[0]),
        }

    def _remember(self, step: Step) -> None:
        self._path.append(self.world.pose[0])
        self._colliding = step.events.collided[0]
        self._collided |= bool(step.collided[0])
        self._left_arena |= bool(step.left_arena[0])

    def _frame(self) -> Frame:
        scenario = self.world.scenario
        return Frame(
            title=self.world.task.config.name,
            robot=self.world.robot,
            arena=self.world.task.arena,
            task=self.world.task.config,
            path=np.stack(self._path),
            targets=scenario.targets[0],
            leg=int(scenario.leg[0]),
            obstacles=scenario.obstacles[0],
            time_s=float(self.world.step_count[0] * self.world.robot.period_s),
            colliding=self._colliding,
            status=Status.of(self._collided, self._left_arena, bool(self.world.reached[0])),
        )
