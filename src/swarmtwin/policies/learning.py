"""Learns a policy with one seed: stages of training, each followed by an evaluation and a checkpoint."""

import hashlib
import json
import math
from collections.abc import Callable
from pathlib import Path
from typing import Annotated, Any, NamedTuple

import numpy as np
import torch
from pydantic import Field
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.logger import Logger

from swarmtwin.errors import UserError
from swarmtwin.gap.store import load_dynamics
from swarmtwin.policies.algorithm import AlgorithmConfig
from swarmtwin.policies.chances import borrowed_chances
from swarmtwin.policies.checkpoint import (
    algorithm_state,
    read_checkpoint,
    restore_algorithm,
    restore_world,
    world_state,
    write_checkpoint,
)
from swarmtwin.policies.policy import Policy
from swarmtwin.policies.scenes import evaluation_scenes
from swarmtwin.policies.stage import Stage, StageReport
from swarmtwin.policies.vector_env import DivergedError, SharedPolicyEnv
from swarmtwin.robot import Robot, StrictModel
from swarmtwin.trainer import one_thread
from swarmtwin.world.motion import SimulatedMotion
from swarmtwin.world.rollout import roll_out
from swarmtwin.world.task import TaskConfig
from swarmtwin.world.world import World

STEPS_A_REPORT = 50
LEAST_SCALE = 1e-6

Count = Annotated[int, Field(ge=1)]


class Schedule(StrictModel):
    """How long to learn, and how often to look how well.

    Attributes:
        steps: control periods of all worlds.
        evaluate_every: control periods from one evaluation and checkpoint to the next.
        scenes: in which each evaluation rolls the policy out.
    """

    steps: Count
    evaluate_every: Count
    scenes: Count


class SeedResult(NamedTuple):
    """What came of one seed.

    Attributes:
        seed: the seed.
        history: the evaluations.
        weights: of the best policy, by name; the best is that of most success, then of the highest reward.
        best: its evaluation; None where training diverged before the first.
        failed: why the policy cannot be used; None for one that can.
    """

    seed: int
    history: tuple[Stage, ...]
    weights: dict[str, np.ndarray]
    best: Stage | None
    failed: str | None


class Lesson(NamedTuple):
    """One seed to learn with.

    Attributes:
        robot: whose vehicles learn.
        task: what they learn.
        algorithm: how they learn.
        schedule: how long they learn.
        simulation: folder of the dynamics model that moves them.
        digest: of that model.
        seed: of everything random.
        checkpoint: the file from which an interrupted training continues, written after each evaluation.
    """

    robot: Robot
    task: TaskConfig
    algorithm: AlgorithmConfig
    schedule: Schedule
    simulation: Path
    digest: str
    seed: int
    checkpoint: Path | None

    def run(self, report: StageReport | None) -> SeedResult:
        """Learn, on one thread; interrupted and continued, the numbers are the same bit for bit."""
        with one_thread(), borrowed_chances():
            return Learner(self).learn(report)

    @property
    def identity(self) -> str:
        """Tells apart trainings that may not continue each other."""
        parts = (self.robot, self.task, self.algorithm, self.schedule)
        settings = [part.model_dump(mode="json") for part in parts]
        return hashlib.sha256(json.dumps([*settings, self.digest, self.seed]).encode()).hexdigest()


class Learner:
    """One training: its world, its algorithm, and what has come of it so far."""

    def __init__(self, lesson: Lesson) -> None:
        self.lesson = lesson
        self.task = lesson.task.build(lesson.robot)
        dynamics = load_dynamics(lesson.simulation)
        worlds = lesson.algorithm.worlds
        world = World(self.task, SimulatedMotion(dynamics, worlds, self.task.vehicles), worlds, lesson.seed)
        scenes = lesson.schedule.scenes
        self._judged = World(self.task, SimulatedMotion(dynamics, scenes, self.task.vehicles), scenes, 0)
        self._scene = evaluation_scenes(self.task, scenes)
        self.env = SharedPolicyEnv(world, reward_scale=1.0)
        self.algorithm = lesson.algorithm.build(self.env, lesson.seed)
        self.algorithm.set_logger(Logger(folder=None, output_formats=[]))
        self.history: list[Stage] = []
        self.best: Stage | None = None
        self.weights: dict[str, torch.Tensor] = {}
        self.diverged = False

    @property
    def policy(self) -> Policy:
        """The policy as it is now."""
        lesson = self.lesson
        layers = lesson.algorithm.layers_of(self.algorithm)
        return Policy.of_layers(lesson.robot, self.task.observation_names, lesson.algorithm.architecture, layers)

    def learn(self, report: StageReport | None) -> SeedResult:
        """Learn to the end of the schedule, from the checkpoint if there is one."""
        if not self._continue():
            self._begin_with_random_play()
        while not self.diverged and self.steps_done < self.lesson.schedule.steps:
            self._stage(report)
            self._write_checkpoint()
        weights = {name: tensor.numpy().copy() for name, tensor in self.weights.items()}
        return SeedResult(self.lesson.seed, tuple(self.history), weights, self.best, self._why_failed())

    @property
    def steps_done(self) -> int:
        """Control periods trained."""
        return self.algorithm.num_timesteps // self.env.num_envs

    def _stage(self, report: StageReport | None) -> None:
        schedule, seed = self.lesson.schedule, self.lesson.seed
        left = min(schedule.evaluate_every, schedule.steps - self.steps_done)
        at_a_time = self.lesson.algorithm.steps_at_a_time
        steps = math.ceil(left / at_a_time) * at_a_time
        last = self.history[-1] if self.history else None
        tell = _Telling(lambda done: report(seed, done, last)) if report else None
        try:
            self.algorithm.learn(steps * self.env.num_envs, tell, log_interval=None, reset_num_timesteps=False)  # type: ignore[arg-type]
        except (DivergedError, ValueError):
            if self._is_finite():
                raise
            self.diverged = True
            return
        if not self._is_finite():
            self.diverged = True
            return
        self._evaluate()
        if report:
            report(seed, self.steps_done, self.history[-1])

    def _evaluate(self) -> None:
        policy = self.policy
        self._judged.start(self._scene)
        stage = Stage.of(self.steps_done, roll_out(self._judged, policy.act))
        self.history.append(stage)
        if self.best is None or (stage.success, stage.reward) > (self.best.success, self.best.reward):
            self.best = stage
            self.weights = dict(policy.state_dict())

    def _is_finite(self) -> bool:
        return all(bool(weights.isfinite().all()) for weights in self.policy.parameters())

    def _begin_with_random_play(self) -> None:
        """Scale rewards by those of random play (as the authors' code does); let critics begin with its value."""
        robot, algorithm = self.lesson.robot, self.lesson.algorithm
        rng = np.random.default_rng([self.lesson.seed, 1])
        world = self.env.world
        played = roll_out(world, lambda _: rng.uniform(robot.command_low, robot.command_high, world.shape))
        reward = float(played.mean_reward.mean())
        self.env.reward_scale = max(abs(reward), LEAST_SCALE) / algorithm.reward_size
        algorithm.expect(self.algorithm, reward / self.env.reward_scale / (1.0 - algorithm.gamma))

    def _why_failed(self) -> str | None:
        if self.diverged:
            return "its weights were no longer finite"
        if self.best is not None and self.best.success == 0:
            return "it never succeeded in the evaluation scenes"
        return None

    def _continue(self) -> bool:
        lesson = self.lesson
        state = read_checkpoint(lesson.checkpoint, lesson.identity, lesson.seed)
        if not state:
            return False
        self.history = [Stage(*stage) for stage in state["history"]]
        self.best = Stage(*state["best"]) if state["best"] else None
        self.weights, self.diverged = state["weights"], state["diverged"]
        self.env.reward_scale = state["reward_scale"]
        restore_world(self.env.world, state)
        restore_algorithm(self.algorithm, state["algorithm"])
        return True

    def _write_checkpoint(self) -> None:
        if self.lesson.checkpoint is None:
            return
        state: dict[str, Any] = {
            "identity": self.lesson.identity,
            "history": [tuple(stage) for stage in self.history],
            "best": tuple(self.best) if self.best else (),
            "weights": self.weights,
            "diverged": self.diverged,
            "reward_scale": self.env.reward_scale,
            "algorithm": algorithm_state(self.algorithm),
            **world_state(self.env.world),
        }
        write_checkpoint(self.lesson.checkpoint, state)


class _Telling(BaseCallback):
    """Tells now and then how many control periods have been trained."""

    def __init__(self, tell: Callable[[int], None]) -> None:
        super().__init__()
        self._tell = tell

    def _on_step(self) -> bool:
        done = self.num_timesteps // self.training_env.num_envs
        if done % STEPS_A_REPORT == 0:
            self._tell(done)
        return True


def check_task(robot: Robot, task: TaskConfig, simulation: Path) -> None:
    """Check that a task can be learned in a simulation, before anything is started.

    Raises:
        UserError: the robot cannot do the task, or the simulation is of another robot.
    """
    built = task.build(robot)
    dynamics = load_dynamics(simulation)
    if dynamics.robot.name != robot.name:
        raise UserError(f"{simulation} is a model of robot {dynamics.robot.name!r}: add robot={dynamics.robot.name}")
    World(built, SimulatedMotion(dynamics, 1, built.vehicles), 1, 0)
