"""Roll-outs recorded: what a policy did in a world, and the figures that say how well."""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Literal, NamedTuple

import numpy as np
from scipy.stats import binomtest

from swarmtwin.robot import Arena, Robot
from swarmtwin.world.motion import Motion
from swarmtwin.world.scenario import Scenario
from swarmtwin.world.task import Task, TaskConfig
from swarmtwin.world.world import Step, World

NEVER = -1

Act = Callable[[np.ndarray], np.ndarray]
"""Observations (W, K, o) → commands (W, K, m) in the robot's units."""


@dataclass(frozen=True)
class Rollout:
    """T periods of W roll-outs of K vehicles, from the same moment on.

    A roll-out that ended early stands still for the rest of the time; `counted` says which periods are part of it.

    Attributes:
        robot: whose vehicles they are.
        arena: where they drove.
        task: what they were asked to do.
        scenario: where they began; its legs are the first ones.
        pose: (T + 1, W, K, 3) as measured.
        leg: (T + 1, W) index of the target sought from then on.
        command: (T, W, K, m) as sent.
        reward: (T, W, K); 0 where not counted.
        counted: (T, W).
        collided: (T, W, K) whether a vehicle collided.
        left_arena: (T, W, K) whether a vehicle was outside the arena.
        at_target: (T, W, K) whether a vehicle was within reach of the target it sought.
        reached: (T, W) whether all targets had been reached by then.
    """

    robot: Robot
    arena: Arena
    task: TaskConfig
    scenario: Scenario
    pose: np.ndarray
    leg: np.ndarray
    command: np.ndarray
    reward: np.ndarray
    counted: np.ndarray
    collided: np.ndarray
    left_arena: np.ndarray
    at_target: np.ndarray
    reached: np.ndarray

    def __len__(self) -> int:
        return len(self.scenario)

    @property
    def periods(self) -> np.ndarray:
        """How many periods each roll-out lasted, (W,)."""
        periods: np.ndarray = self.counted.sum(axis=0)
        return periods

    @property
    def collided_step(self) -> np.ndarray:
        """The period, from 1, in which each roll-out had its first collision; `NEVER` where it had none. (W,)."""
        return _first(np.any(self.collided, axis=2))

    @property
    def left_step(self) -> np.ndarray:
        """The period, from 1, in which the first vehicle left the arena; `NEVER` where none did. (W,)."""
        return _first(np.any(self.left_arena, axis=2))

    @property
    def reached_step(self) -> np.ndarray:
        """The period, from 1, at whose end all targets had been reached and held; `NEVER` otherwise. (W,)."""
        return _first(self.reached)

    @property
    def success(self) -> np.ndarray:
        """Whether all targets were reached, and nothing ever collided or left the arena, (W,)."""
        return (self.reached_step != NEVER) & (self.collided_step == NEVER) & (self.left_step == NEVER)

    @property
    def mean_reward(self) -> np.ndarray:
        """The reward per vehicle and step, as in the paper's tables 5 and 6, (W,)."""
        mean: np.ndarray = self.reward.mean(axis=2).sum(axis=0) / self.periods
        return mean

    @property
    def reach_time_s(self) -> np.ndarray:
        """Time until all targets had been reached and held; NaN where they were not. (W,)."""
        return np.where(self.reached_step == NEVER, np.nan, self.reached_step * self.robot.period_s)

    @property
    def target(self) -> np.ndarray:
        """The target sought at each moment, (T + 1, W, 2), or (T + 1, W, K, 2) where each vehicle has its own."""
        target: np.ndarray = self.scenario.targets[np.arange(len(self)), self.leg]
        return target

    @property
    def target_distance_mm(self) -> np.ndarray:
        """Each vehicle's distance from the target it seeks, (T + 1, W, K); NaN where there is none."""
        target = self.target
        away = self.pose[..., :2] - (target[:, :, None] if target.ndim == 3 else target)
        return np.hypot(away[..., 0], away[..., 1])

    @property
    def final_distance_mm(self) -> np.ndarray:
        """How far the farthest vehicle was from its target in the end, (W,); NaN where there is none."""
        farthest: np.ndarray = self.target_distance_mm[-1].max(axis=1)
        return farthest

    def until(self, period: int) -> "Rollout":
        """Return the first so many periods of the roll-outs."""
        moments = {name: getattr(self, name)[: period + 1] for name in ("pose", "leg")}
        along_time = ("command", "reward", "counted", "collided", "left_arena", "at_target", "reached")
        parts = {name: getattr(self, name)[:period] for name in along_time}
        return Rollout(self.robot, self.arena, self.task, self.scenario, **moments, **parts)

    def where(self, worlds: np.ndarray) -> "Rollout":
        """Return some of the roll-outs: indices (n,) or a mask (W,)."""
        along_time = ("pose", "leg", "command", "reward", "counted", "collided", "left_arena", "at_target", "reached")
        parts = {name: getattr(self, name)[:, worlds] for name in along_time}
        return Rollout(self.robot, self.arena, self.task, self.scenario.where(worlds), **parts)


def roll_out(world: World, act: Act) -> Rollout:
    """Play a world from its start to the end of all its roll-outs.

    Raises:
        UserError: a command is not finite.
        ValueError: the world has been played already: reset it, or start it in a scenario.
    """
    if world.step_count.any():
        raise ValueError("the world has been played already: reset it, or start it in a scenario")
    scenario, poses, legs = world.scenario, [world.pose], [world.scenario.leg]
    observation = world.observe()
    steps: list[Step] = []
    while not world.ended.all():
        step = world.step(act(observation))
        observation = step.observation
        steps.append(step)
        poses.append(world.pose)
        legs.append(world.scenario.leg)
    return Rollout(
        robot=world.robot,
        arena=world.task.arena,
        task=world.task.config,
        scenario=scenario,
        pose=np.stack(poses),
        leg=np.stack(legs),
        command=np.stack([step.command for step in steps]),
        reward=np.stack([step.reward for step in steps]),
        counted=np.stack([step.counted for step in steps]),
        collided=np.stack([step.events.collided for step in steps]),
        left_arena=np.stack([step.events.left_arena for step in steps]),
        at_target=np.stack([step.events.at_target for step in steps]),
        reached=np.stack([step.reached for step in steps]),
    )


def play(task: Task, motion: Motion, scenario: Scenario, act: Act, compiled: bool = False) -> Rollout:
    """Roll a task out from the W worlds of a scenario, moved by a motion of as many; `compiled` as of the `World`.

    Raises:
        UserError: a command or a pose is not finite.
    """
    world = World(task, motion, len(scenario), seed=0, compiled=compiled)
    world.start(scenario)
    return roll_out(world, act)


Show = Literal["typical", "best", "worst"]
"""Which roll-out to show: that of median reward, or the best or worst, where failing is worse than any reward."""


def chosen_world(rollout: Rollout, show: Show) -> int:
    """Return the index of the roll-out to show."""
    if show == "typical":
        return int(np.argsort(rollout.mean_reward, kind="stable")[len(rollout) // 2])
    order = np.lexsort((rollout.mean_reward, rollout.success))
    return int(order[0 if show == "worst" else -1])


class Rate(NamedTuple):
    """A share of roll-outs, with Wilson's 95 % interval."""

    value: float
    low: float
    high: float

    @classmethod
    def of(cls, happened: np.ndarray) -> "Rate":
        """Return the share of what happened, (W,) bool; W at least 1."""
        interval = binomtest(int(np.sum(happened)), len(happened)).proportion_ci(0.95, method="wilson")
        return cls(float(np.mean(happened)), float(interval.low), float(interval.high))


class RolloutFigures(NamedTuple):
    """How well a policy did, over W roll-outs: means ± standard deviations, and rates.

    Attributes:
        rollouts: W.
        reward: mean over roll-outs of the reward per vehicle and step.
        reward_sd: its standard deviation over roll-outs.
        success: reached, no collision, nobody left the arena.
        collision: roll-outs with a collision.
        left_arena: roll-outs in which a vehicle left the arena.
        reach_time_s: mean time to reach, over the roll-outs that did; NaN where none did.
        reach_time_sd_s: its standard deviation.
        final_distance_mm: mean distance of the farthest vehicle from its target in the end; NaN where there is none.
        final_distance_sd_mm: its standard deviation.
    """

    rollouts: int
    reward: float
    reward_sd: float
    success: Rate
    collision: Rate
    left_arena: Rate
    reach_time_s: float
    reach_time_sd_s: float
    final_distance_mm: float
    final_distance_sd_mm: float


def figures_of(rollout: Rollout) -> RolloutFigures:
    """Summarise roll-outs."""
    reach_time_s = rollout.reach_time_s[rollout.reached_step != NEVER]
    if not len(reach_time_s):
        reach_time_s = np.array([np.nan])
    return RolloutFigures(
        rollouts=len(rollout),
        reward=float(rollout.mean_reward.mean()),
        reward_sd=float(rollout.mean_reward.std()),
        success=Rate.of(rollout.success),
        collision=Rate.of(rollout.collided_step != NEVER),
        left_arena=Rate.of(rollout.left_step != NEVER),
        reach_time_s=float(reach_time_s.mean()),
        reach_time_sd_s=float(reach_time_s.std()),
        final_distance_mm=float(rollout.final_distance_mm.mean()),
        final_distance_sd_mm=float(rollout.final_distance_mm.std()),
    )


def _first(happened: np.ndarray) -> np.ndarray:
    """Return the first period, from 1, in which something happened (T, W); `NEVER` where it did not. (W,)."""
    return np.where(np.any(happened, axis=0), happened.argmax(axis=0) + 1, NEVER)
