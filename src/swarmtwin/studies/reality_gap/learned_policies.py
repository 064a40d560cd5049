"""Policies learned in simulations that are compared: what came of each, and how it learned."""

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

import pandas as pd

from swarmtwin.errors import UserError
from swarmtwin.files import CHECKPOINTS
from swarmtwin.learning.device import torch_device
from swarmtwin.learning.progress_bars import training_bars
from swarmtwin.policies.algorithm import algorithm_config
from swarmtwin.policies.initial_policy import InitialPolicy
from swarmtwin.policies.learned_folder import history_table, origin_of, save_learned
from swarmtwin.policies.policy_folder import SimulationOrigin, StoredPolicy, load_policy
from swarmtwin.policies.seeds import LearningOptions, best_of, learn_all, policy_jobs
from swarmtwin.policies.training import PolicyJob, SeedResult, task_in
from swarmtwin.simulation.evaluation import load_simulation
from swarmtwin.simulation.randomisation import Randomisation
from swarmtwin.simulation.simulation import Simulation
from swarmtwin.studies.reality_gap.options import GapOptions
from swarmtwin.tracking.model_source import model_folder
from swarmtwin.world.task import Task, task_config


@dataclass(frozen=True)
class Candidate:
    """A simulation that policies are learned in.

    Attributes:
        name: in the table.
        folder: where it lies.
        origin: what it is.
        simulation: loaded.
        task: as it is done in the simulation's arena.
    """

    name: str
    folder: Path
    origin: SimulationOrigin
    simulation: Simulation
    task: Task

    def jobs(
        self,
        options: LearningOptions,
        output: Path,
        start_from: Mapping[int, InitialPolicy] | None = None,
        randomisation: Randomisation | None = None,
    ) -> list[PolicyJob]:
        """Return a job for each seed that learns in it, going on from its checkpoint in the `output` of a command."""
        algorithm = algorithm_config(options.policy, "policy")
        about = (algorithm, self.task.config, self.folder, self.origin.digest, output / CHECKPOINTS, f"{self.name}-")
        return policy_jobs(options, *about, start_from, randomisation)


@dataclass(frozen=True)
class Learned:
    """What came of learning in a simulation.

    Attributes:
        policy: the best of all seeds; None where all have failed.
        failed: why there is none.
        seeds: what came of each seed.
    """

    policy: StoredPolicy | None
    failed: str | None
    seeds: tuple[SeedResult, ...]

    @property
    def history(self) -> pd.DataFrame:
        """The evaluations of all seeds while they learned."""
        return history_table(self.seeds)


def load_candidates(options: GapOptions) -> list[Candidate]:
    """Load the simulations; all must do the task in the same arena, or roll-outs could not begin alike.

    Raises:
        UserError: one is missing, of another robot, cannot do the task, or has another arena than the first.
    """
    candidates = [load_candidate(name, reference, options) for name, reference in options.simulations.items()]
    first = candidates[0]
    for other in candidates[1:]:
        if other.task.arena != first.task.arena:
            raise UserError(
                f"simulations {first.name!r} and {other.name!r} were learned in different arenas, so that roll-outs "
                "cannot begin alike: compare simulations of one arena"
            )
    return candidates


def load_candidate(name: str, reference: str, options: LearningOptions) -> Candidate:
    """Load one simulation.

    Raises:
        UserError: it is missing, of another robot, or cannot do the task.
    """
    folder = model_folder(reference)
    simulation, _ = load_simulation(folder, options.robot)
    task = task_in(folder, options.robot, task_config(options.task, "task"), options.sampled)
    on_device = simulation.to(torch_device(options.device))
    return Candidate(name, folder, origin_of(reference, folder), on_device, task)


def learn_in(
    candidate: Candidate, options: LearningOptions, output: Path, start_from: Mapping[int, InitialPolicy] | None = None
) -> Learned:
    """Learn a policy with all seeds, going on from the checkpoints in `output`, and save the best in `policies/` there.

    Seeds begin with the policies that `start_from` has for them, and from nothing where it has none. Where all seeds
    have failed there is no policy: a simulation in which nothing can be learned is a result.
    """
    jobs = candidate.jobs(options, output, start_from)
    told = f"{options.robot.name}-{candidate.task.config.name} in {candidate.name}"
    with training_bars(told, jobs[0].schedule.all_steps) as report:
        results = tuple(learn_all(jobs, report))
    if all(result.failed for result in results):
        return Learned(None, "; ".join(f"seed {result.seed}: {result.failed}" for result in results), results)
    folder = output / "policies" / candidate.name
    folder.mkdir(parents=True)
    best = best_of(results).seed
    save_learned(folder, candidate.task, next(job for job in jobs if job.seed == best), results, candidate.origin)
    return Learned(load_policy(folder, options.robot), None, results)


def learning_table(learned: Mapping[str, Learned]) -> pd.DataFrame:
    """Return learning.csv: the evaluations of all seeds in all simulations while they learned."""
    return pd.concat([one.history.assign(simulation=name) for name, one in learned.items()])
