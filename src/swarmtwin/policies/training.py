"""Learns a policy with one seed: spans of training, each followed by an evaluation and a checkpoint."""

import hashlib
import json
import math
from collections.abc import Callable
from pathlib import Path
from typing import NamedTuple

import numpy as np
import torch
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.logger import Logger

from swarmtwin.errors import UserError
from swarmtwin.learning.device import Device, one_thread, torch_device
from swarmtwin.policies.algorithm import AlgorithmConfig
from swarmtwin.policies.checkpoint import (
    Content,
    algorithm_state,
    global_rng_kept,
    pack,
    read_checkpoint,
    restore_algorithm,
    unpack,
    write_checkpoint,
)
from swarmtwin.policies.initial_policy import InitialPolicy
from swarmtwin.policies.policy import Policy
from swarmtwin.policies.rollout_comparison import Evaluation, draw_scenarios
from swarmtwin.policies.schedule import Schedule
from swarmtwin.policies.vector_env import DivergedError, SharedPolicyEnv
from swarmtwin.robot import Arena, Robot
from swarmtwin.simulation.displacement_table import TableSettings, tabulated
from swarmtwin.simulation.randomisation import Randomisation
from swarmtwin.simulation.simulation import Simulation
from swarmtwin.simulation.simulation_folder import load_simulation
from swarmtwin.world.motion import SimulatedMotion
from swarmtwin.world.randomised_motion import motion_in
from swarmtwin.world.rollout import Rollout, play, roll_out
from swarmtwin.world.scenario import Scenario
from swarmtwin.world.task import Task, TaskConfig
from swarmtwin.world.world import World

LearningReport = Callable[[int, int, Evaluation | None], None]
"""Called now and then with the seed, the control periods done, and the last evaluation."""


class SeedResult(NamedTuple):
    """What came of one seed.

    Attributes:
        seed: the seed.
        history: the evaluations.
        weights: of the best policy, by name; of the finalists, that of most success, then of the highest reward.
        best: how it did in the final scenarios; None where training diverged before the first evaluation.
        failed: why the policy cannot be used; None for one that can.
    """

    seed: int
    history: tuple[Evaluation, ...]
    weights: dict[str, np.ndarray]
    best: Evaluation | None
    failed: str | None


class PolicyJob(NamedTuple):
    """One seed to learn with.

    Attributes:
        robot: whose vehicles learn.
        task: what they learn.
        algorithm: how they learn.
        schedule: how long they learn.
        simulation: folder of the simulation that moves them.
        digest: of that simulation.
        seed: of everything random.
        checkpoint: the file from which an interrupted training continues, written after each evaluation.
        sampled: whether their motion is drawn or the most likely one; None: as `SimulatedMotion` chooses.
        device: where the networks are trained.
        tabulated: whether a table of the simulation's displacements moves them; None: where it is accurate.
        table: how fine that is.
        randomisation: what differs from roll-out to roll-out; None: nothing.
        arena: where they drive; None: the arena of the simulation.
        initial: the policy that learning goes on from, the first that is evaluated; None: it begins from nothing.
    """

    robot: Robot
    task: TaskConfig
    algorithm: AlgorithmConfig
    schedule: Schedule
    simulation: Path
    digest: str
    seed: int
    checkpoint: Path | None
    sampled: bool | None = None
    device: Device = "auto"
    tabulated: bool | None = None
    table: TableSettings = TableSettings()
    randomisation: Randomisation | None = None
    arena: Arena | None = None
    initial: InitialPolicy | None = None

    def run(self, report: LearningReport | None) -> SeedResult:
        """Learn, on one thread; interrupted and continued, the numbers are the same bit for bit."""
        with one_thread(), global_rng_kept():
            return _learn(self, report)

    @property
    def identity(self) -> str:
        """Tells apart trainings that may not continue each other."""
        parts = (self.robot, self.task, self.algorithm, self.schedule, self.table)
        settings = [part.model_dump(mode="json") for part in parts]
        others = [self.digest, self.seed, self.sampled, torch_device(self.device).type, self.tabulated]
        for part in (self.randomisation, self.arena):
            others.append(part.model_dump(mode="json") if part else None)
        if self.initial:
            others.append(self.initial.origin.digest)
        return hashlib.sha256(json.dumps([*settings, *others]).encode()).hexdigest()


class Learner:
    """One start of a training: its world, its algorithm, and what has come of it so far.

    Attributes:
        number: of the start, from 0.
        steps_before: control periods that other starts have learned for by now.
    """

    def __init__(self, job: PolicyJob, number: int = 0) -> None:
        self.job = job
        self.number = number
        self.steps_before = number * job.schedule.start_steps
        self._seed = _seed_of_start(job.seed, number)
        simulation = tabulated(load_simulation(job.simulation), job.table, job.tabulated)
        self.simulation = simulation.to(torch_device(job.device))
        self.task = job.task.build(job.robot, job.arena or self.simulation.conditions.arena_mm)
        worlds = job.algorithm.worlds
        vehicles = self.task.vehicles
        self.motion = motion_in(self.simulation, worlds, vehicles, job.sampled, self._seed, job.randomisation)
        world = World(self.task, self.motion, worlds, self._seed, compiled=True)
        self.env = SharedPolicyEnv(world, reward_scale=1.0)
        self.algorithm = job.algorithm.build(self.env, self._seed, torch_device(job.device).type)
        self.algorithm.set_logger(Logger(folder=None, output_formats=[]))
        self.scenarios = draw_scenarios(self.task, job.schedule.scenes, "evaluation", seed=0)
        self.history: list[Evaluation] = []
        self.finalists: list[_Candidate] = []
        self.diverged = False

    @property
    def policy(self) -> Policy:
        """The policy as it is now."""
        algorithm = self.job.algorithm
        layers = algorithm.layers_of(self.algorithm)
        return Policy.of_layers(self.job.robot, self.task.observation_names, algorithm.architecture, layers)

    @property
    def steps_done(self) -> int:
        """Control periods trained."""
        return self.algorithm.num_timesteps // self.env.num_envs

    @property
    def reward(self) -> float:
        """The mean reward of the policy in its last evaluation; −∞ where training diverged."""
        return -math.inf if self.diverged else self.history[-1].reward

    def begin(self) -> None:
        """Begin from nothing, or from the policy that learning goes on from, which is evaluated first."""
        self.scale_rewards()
        if self.job.initial:
            self._begin_with(self.job.initial)
        self.env.begin()

    def learn_until(self, steps: int, report: LearningReport | None, keep: Callable[[], None]) -> None:
        """Learn for so many control periods in all; after each evaluation, `keep` what has come of it."""
        while not self.diverged and self.steps_done < steps:
            self._train_until_next_evaluation(steps, report)
            keep()

    def result(self) -> SeedResult:
        """Roll the finalists out, and return what came of this start."""
        best = self._best_finalist()
        weights = {name: tensor.numpy().copy() for name, tensor in best.weights.items()} if best else {}
        failed = self._why_failed(best)
        return SeedResult(self.job.seed, tuple(self.history), weights, best.evaluation if best else None, failed)

    def scale_rewards(self) -> None:
        """Scale rewards by those of random play (as the authors' code does); let critics begin with its value."""
        robot, algorithm, world = self.job.robot, self.job.algorithm, self.env.world
        rng = np.random.default_rng([self._seed, 1])
        played = roll_out(world, lambda _: rng.uniform(robot.command_low, robot.command_high, world.shape))
        reward = float(played.mean_reward.mean())
        self.env.reward_scale = max(abs(reward), 1e-6) / algorithm.reward_size  # never a division by zero
        algorithm.expect(self.algorithm, reward / self.env.reward_scale / (1.0 - algorithm.gamma))

    def _begin_with(self, initial: InitialPolicy) -> None:
        """Let the actor begin with a policy, and critics with its value instead of that of random play."""
        algorithm = self.job.algorithm
        policy = self._with({name: torch.from_numpy(values) for name, values in initial.weights.items()})
        algorithm.begin_with(self.algorithm, policy)
        self._evaluate()
        algorithm.expect(self.algorithm, self.reward / self.env.reward_scale / (1.0 - algorithm.gamma))

    def _train_until_next_evaluation(self, steps_in_all: int, report: LearningReport | None) -> None:
        schedule, seed = self.job.schedule, self.job.seed
        left = min(schedule.evaluate_every, steps_in_all - self.steps_done)
        at_a_time = self.job.algorithm.steps_at_a_time
        steps = math.ceil(left / at_a_time) * at_a_time
        last = self.history[-1] if self.history else None
        before = self.steps_before
        callback = _ReportProgress(lambda done: report(seed, before + done, last), schedule.steps) if report else None
        try:
            self.algorithm.learn(steps * self.env.num_envs, callback, log_interval=None, reset_num_timesteps=False)  # type: ignore[arg-type]
        except (DivergedError, ValueError):
            if self._is_finite():
                raise
        if not self._is_finite():
            self.diverged = True
            return
        self._evaluate()
        if report:
            report(seed, before + self.steps_done, self.history[-1])

    def _evaluate(self) -> None:
        """Roll the policy out from the evaluation scenarios; what is drawn there is the same every time."""
        policy = self.policy
        evaluation = self._rolled_out(policy, self.steps_done, self.scenarios)
        self.history.append(evaluation)
        candidates = [*self.finalists, _Candidate(evaluation, dict(policy.state_dict()))]
        candidates.sort(key=lambda candidate: candidate.evaluation.rank, reverse=True)
        self.finalists = candidates[: self.job.schedule.finalists]

    def _best_finalist(self) -> "_Candidate | None":
        """Return the finalist that does best in the final scenarios, with how it does there."""
        scenarios = draw_scenarios(self.task, self.job.schedule.final_scenes, "evaluation", seed=1)
        rolled_out = [
            _Candidate(self._rolled_out(self._with(weights), evaluation.step, scenarios), weights)
            for evaluation, weights in self.finalists
        ]
        return max(rolled_out, key=lambda candidate: candidate.evaluation.rank, default=None)

    def _with(self, weights: dict[str, torch.Tensor]) -> Policy:
        architecture = self.job.algorithm.architecture
        return Policy.with_weights(self.job.robot, self.task.observation_names, architecture, weights)

    def _rolled_out(self, policy: Policy, step: int, scenarios: Scenario) -> Evaluation:
        return Evaluation.of(step, roll_out_in(self.simulation, self.task, policy, scenarios, self.job))

    def _is_finite(self) -> bool:
        return all(bool(weights.isfinite().all()) for weights in self.policy.parameters())

    def _why_failed(self, best: "_Candidate | None") -> str | None:
        if self.diverged:
            return "its weights were no longer finite"
        if best is not None and best.evaluation.success == 0:
            return "it never succeeded in the final scenarios"
        return None

    def restore(self, state: Content) -> None:
        """Continue from a `state` of the same start."""
        self.history = [Evaluation(**evaluation) for evaluation in state["history"]]
        self.finalists = [_Candidate(Evaluation(**evaluation), weights) for evaluation, weights in state["finalists"]]
        self.diverged = state["diverged"]
        self.env.reward_scale = state["reward_scale"]
        self.motion.restore(unpack(state["motion"]))
        self.env.world.restore(unpack(state["world"]))
        restore_algorithm(self.algorithm, state["algorithm"])

    def state(self) -> Content:
        """Return all that learning goes on from."""
        return {
            "number": self.number,
            "reward": self.reward,
            "history": [evaluation.model_dump() for evaluation in self.history],
            "finalists": [(evaluation.model_dump(), weights) for evaluation, weights in self.finalists],
            "diverged": self.diverged,
            "reward_scale": self.env.reward_scale,
            "motion": pack(self.motion.state()),
            "world": pack(self.env.world.state()),
            "algorithm": algorithm_state(self.algorithm),
        }


def _learn(job: PolicyJob, report: LearningReport | None) -> SeedResult:
    """Learn with one seed to the end of its schedule, from the checkpoint if there is one."""
    schedule = job.schedule
    kept = read_checkpoint(job.checkpoint, job.identity, job.seed)
    learner = _restored(job, kept["learner"]) if kept else _begun(job, 0)
    leading: Content | None = kept.get("leading")  # of the starts before this one, that with the highest reward
    chosen: bool = kept.get("chosen", schedule.starts == 1)

    def keep() -> None:
        if job.checkpoint is not None:
            content = {"identity": job.identity, "learner": learner.state(), "leading": leading, "chosen": chosen}
            write_checkpoint(job.checkpoint, content)

    while not chosen:
        learner.learn_until(schedule.start_steps, report, keep)
        if leading is None or learner.reward > leading["reward"]:
            leading = learner.state()
        if learner.number + 1 < schedule.starts:
            learner = _begun(job, learner.number + 1)
        else:
            learner = _restored(job, leading)
            leading, chosen = None, True
    learner.steps_before = schedule.all_steps - schedule.steps
    learner.learn_until(schedule.steps, report, keep)
    return learner.result()


def _begun(job: PolicyJob, number: int) -> Learner:
    learner = Learner(job, number)
    learner.begin()
    return learner


def _restored(job: PolicyJob, state: Content) -> Learner:
    learner = Learner(job, state["number"])
    learner.restore(state)
    return learner


def _seed_of_start(seed: int, number: int) -> int:
    """Return the seed of a start of a training: its own for the first one."""
    return seed if number == 0 else int(np.random.SeedSequence([seed, number]).generate_state(1)[0])


class _Candidate(NamedTuple):
    """A policy by its weights, and how it did when it was last rolled out."""

    evaluation: Evaluation
    weights: dict[str, torch.Tensor]


def roll_out_in(simulation: Simulation, task: Task, policy: Policy, scenarios: Scenario, job: PolicyJob) -> Rollout:
    """Roll a policy out from the W worlds of some scenarios, in the simulation of its training, randomised likewise.

    What is drawn is the same every time.
    """
    motion = motion_in(simulation, len(scenarios), task.vehicles, job.sampled, 0, job.randomisation)
    return play(task, motion, scenarios, policy.act, compiled=True)


class _ReportProgress(BaseCallback):
    """Tells how many control periods have been trained, after each hundredth of all `steps`."""

    def __init__(self, report: Callable[[int], None], steps: int) -> None:
        super().__init__()
        self._report = report
        self._every = max(1, steps // 100)

    def _on_step(self) -> bool:
        done = self.num_timesteps // self.training_env.num_envs
        if done % self._every == 0:
            self._report(done)
        return True


def task_in(
    simulation: Path, robot: Robot, task: TaskConfig, sampled: bool | None = None, arena: Arena | None = None
) -> Task:
    """Return a task as it is learned in a simulation, in its arena or another; checked before anything is started.

    Raises:
        UserError: the robot cannot do the task there, the simulation is of another robot, or it cannot be sampled.
    """
    loaded = load_simulation(simulation)
    if loaded.robot.name != robot.name:
        raise UserError(f"{simulation} is a model of robot {loaded.robot.name!r}: add robot={loaded.robot.name}")
    built = task.build(robot, arena or loaded.conditions.arena_mm)
    World(built, SimulatedMotion(loaded, 1, built.vehicles, sampled), 1, 0)
    return built


def policy_of(task: Task, algorithm: AlgorithmConfig, result: SeedResult) -> Policy:
    """Return the best policy of a seed that learned a task."""
    weights = {name: torch.from_numpy(values) for name, values in result.weights.items()}
    return Policy.with_weights(task.robot, task.observation_names, algorithm.architecture, weights)


def tested(task: Task, job: PolicyJob, policy: Policy) -> Rollout:
    """Return roll-outs of a policy in the simulation that it was learned in, from scenarios that chose nothing."""
    simulation = tabulated(load_simulation(job.simulation), job.table, job.tabulated)
    scenarios = draw_scenarios(task, job.schedule.final_scenes, "evaluation", seed=2)
    with one_thread():
        return roll_out_in(simulation, task, policy, scenarios, job)
