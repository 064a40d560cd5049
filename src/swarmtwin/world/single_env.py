"""One vehicle as a gymnasium environment, for tasks that have one."""

from typing import Any

import gymnasium
import numpy as np

from swarmtwin.errors import UserError
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


def single_env(task: Task | str, motion: Moved, seed: int = 0, render_mode: str | None = None) -> "VehicleEnv":
    """Return the environment of a task with one vehicle, moved by `motion`.

    Args:
        task: what the vehicle is asked to do, or the name of a file in `conf/task/`.
        motion: what moves it, of one world; or a simulation; or a model's folder, as train or a diagnosis leaves it.
        seed: of the scenarios.
        render_mode: `rgb_array`, or None: no pictures.

    Raises:
        UserError: there is no such task, model or render mode, the task has several vehicles, or the motion is of
            another robot.
    """
    return VehicleEnv(open_world(task, motion, seed=seed), render_mode)


class VehicleEnv(gymnasium.Env[np.ndarray, np.ndarray]):
    """An action is a command in the robot's units; `info` is that of an agent of `SwarmEnv`."""

    def __init__(self, world: World, render_mode: str | None = None) -> None:
        if world.task.vehicles != 1:
            raise UserError(
                f"task {world.task.config.name!r} is for {world.task.vehicles} vehicles, a gymnasium environment for "
                "one: use parallel_env of swarmtwin.world.parallel_env, or vector_env of swarmtwin.world.vector_env"
            )
        self._live = LiveFrame(world, render_mode)
        self.metadata = self._live.metadata
        self.render_mode = render_mode
        self.world = world
        self.observation_space = observation_space(world.task)
        self.action_space = command_space(world.robot)

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[np.ndarray, dict[str, Any]]:
        """Start in a new scenario; `seed` decides it and the ones after it. There are no `options`."""
        super().reset(seed=seed)
        if seed is not None:
            self.world.reseed(seed)
        observation = self.world.reset()
        self._live.restart()
        return observation[0, 0], {}

    def step(self, action: np.ndarray) -> tuple[np.ndarray, float, bool, bool, dict[str, Any]]:
        """Hold a command (m,) for one control period.

        Raises:
            UserError: it is not finite, or of another shape.
            ValueError: the roll-out is over.
        """
        if self.world.ended[0]:
            raise ValueError("the roll-out has ended: reset the environment")
        robot = self.world.robot
        command = commands_of(action, (len(robot.command),), robot, "the action")
        step = self.world.step(command[None, None])
        self._live.follow(step)
        reward, terminated, truncated = float(step.reward[0, 0]), bool(step.terminated[0]), bool(step.truncated[0])
        return step.observation[0, 0], reward, terminated, truncated, vehicle_info(step, 0)

    def render(self) -> np.ndarray | None:
        """Return a picture (height, width, 3) of the world now, where the render mode asks for one."""
        return self._live.picture()
