"""What decides what the vehicles should do: a policy with its task. Others, such as a planned drive, are alike."""

from collections.abc import Mapping
from typing import Any, Protocol

import numpy as np

from swarmtwin.policies.policy import Policy
from swarmtwin.robot import Robot
from swarmtwin.world.motion import Motion
from swarmtwin.world.rollout import Rollout
from swarmtwin.world.scenario import Scenario
from swarmtwin.world.task import Task
from swarmtwin.world.world import Step, World


class Driver(Protocol):
    """Decides, period by period; poses are as measured, in the arena's frame."""

    def start(self, pose: np.ndarray) -> None:
        """Begin with vehicles at (V, 3)."""

    def decide(self, pose: np.ndarray) -> np.ndarray:
        """Return the commands (V, m) wanted of vehicles that will be at (V, 3) when these take effect."""

    def moved(self, command: np.ndarray, pose: np.ndarray) -> str | None:
        """Take notice that commands (V, m) have led to poses (V, 3); return why all is done now, or None."""

    def shown(self) -> Mapping[str, Any]:
        """Return what people should see: targets, how it stands."""


class _Measured(Motion):
    """A motion that happens outside: the poses are told."""

    def __init__(self, robot: Robot, vehicles: int) -> None:
        self.robot = robot
        self.pose = np.zeros((1, vehicles, 3))

    def place(self, worlds: np.ndarray, pose: np.ndarray) -> np.ndarray:
        return pose

    def move(self, command: np.ndarray) -> np.ndarray:
        return self.pose


class PolicyDriver:
    """A policy that does its task with real vehicles; the world keeps count of rewards, events and success.

    Attributes:
        task: what is asked of the vehicles.
        world: one, whose motion is told.
    """

    def __init__(self, policy: Policy, task: Task, targets: np.ndarray, obstacles: np.ndarray | None = None) -> None:
        """Prepare.

        Args:
            policy: decides.
            task: what is asked of the vehicles.
            targets: (G, 2) to be reached one after the other; (G, V, 2) where each vehicle has its own.
            obstacles: (O, 3) x_mm, y_mm, radius_mm; None: there are none.
        """
        self.task = task
        self._policy = policy
        self._targets = targets[None]
        self._obstacles = None if obstacles is None else obstacles[None]
        self._motion = _Measured(task.robot, task.vehicles)
        self.world = World(task, self._motion, 1, seed=0)
        self._steps: list[Step] = []
        self._poses: list[np.ndarray] = []
        self._legs: list[np.ndarray] = []

    def start(self, pose: np.ndarray) -> None:
        """Begin with vehicles at (V, 3)."""
        self.world.start(self.task.beginning(pose[None].copy(), self._targets, self._obstacles))
        self._begun_in = self.world.scenario
        self._steps, self._poses, self._legs = [], [pose[None].copy()], [self.world.scenario.leg]

    def decide(self, pose: np.ndarray) -> np.ndarray:
        """Return the commands (V, m) of the policy, which sees what was really sent if it looks at past commands."""
        return self._policy.act(self.world.observe_from(pose[None]))[0]

    def moved(self, command: np.ndarray, pose: np.ndarray) -> str | None:
        """Let the world judge where the commands led; return how it ended, or None."""
        self._motion.pose = pose[None]
        step = self.world.step(command[None])
        self._steps.append(step)
        self._poses.append(pose[None].copy())
        self._legs.append(self.world.scenario.leg)
        if step.reached[0]:
            return "all targets are reached"
        if step.terminated[0]:
            return "the task ended with a collision"
        return "the task's time is over" if step.ended[0] else None

    @property
    def scenario(self) -> Scenario:
        """Where it began, and what was asked."""
        return self._begun_in

    @property
    def rollout(self) -> Rollout | None:
        """All that has happened, as one roll-out; None before the first period is over."""
        if not self._steps:
            return None
        stacked = {name: np.stack([getattr(step, name) for step in self._steps]) for name in _OF_STEP}
        events = {name: np.stack([getattr(step.events, name) for step in self._steps]) for name in _OF_EVENTS}
        return Rollout(
            robot=self.task.robot,
            arena=self.task.arena,
            task=self.task.config,
            scenario=self._begun_in,
            pose=np.stack(self._poses),
            leg=np.stack(self._legs),
            **stacked,
            **events,
        )

    def shown(self) -> Mapping[str, Any]:
        """Return the targets sought, reach, obstacles and the mean reward so far."""
        rewards = [float(step.reward.mean()) for step in self._steps]
        last = self._steps[-1].events.at_target[0] if self._steps else np.zeros(self.task.vehicles, bool)
        targets = self.world.scenario.target_of_each[0]
        return {
            "targets_mm": [target.tolist() for target in targets if np.isfinite(target).all()],
            "reach_mm": float(self.task.config.reach_mm),
            "obstacles": self.world.scenario.obstacles[0].tolist(),
            "reward": float(np.mean(rewards)) if rewards else None,
            "at_target": last.tolist(),
        }


_OF_STEP = ("command", "reward", "counted", "reached")
_OF_EVENTS = ("collided", "left_arena", "at_target")
