"""The seeds that learn a policy: what they all do, side by side, and the best of them."""

import logging
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Annotated, Any

from pydantic import Field

from swarmtwin.errors import UserError
from swarmtwin.learning.device import Device
from swarmtwin.learning.parallel import run_side_by_side
from swarmtwin.policies.algorithm import AlgorithmConfig
from swarmtwin.policies.initial_policy import InitialPolicy
from swarmtwin.policies.schedule import Schedule
from swarmtwin.policies.training import LearningReport, PolicyJob, SeedResult
from swarmtwin.robot import Arena, Robot, Seed, StrictModel
from swarmtwin.simulation.displacement_table import TableSettings
from swarmtwin.simulation.randomisation import Randomisation
from swarmtwin.world.task import TaskConfig

Count = Annotated[int, Field(ge=1)]

log = logging.getLogger(__name__)


class LearningOptions(StrictModel):
    """How policies are learned; what each option is stands in conf/learn.yaml."""

    robot: Robot
    task: dict[str, Any]
    policy: dict[str, Any]
    evaluate_every: Count
    scenes: Count
    finalists: Count
    final_scenes: Count
    starts: Count
    start_steps: Count
    sampled: bool | None
    tabulated: bool | None
    table: TableSettings
    device: Device
    seed: Seed
    seeds: Count

    @property
    def all_seeds(self) -> range:
        """The seeds, from the first one."""
        return range(self.seed, self.seed + self.seeds)


def policy_jobs(
    options: LearningOptions,
    algorithm: AlgorithmConfig,
    task: TaskConfig,
    simulation: Path,
    digest: str,
    checkpoints: Path,
    prefix: str = "",
    start_from: Mapping[int, InitialPolicy] | None = None,
    randomisation: Randomisation | None = None,
    arena: Arena | None = None,
) -> list[PolicyJob]:
    """Return a job for each seed.

    Args:
        options: how long each learns, how it is looked at, and which seeds there are.
        algorithm: how it learns.
        task: what it learns.
        simulation: folder of the simulation that moves the vehicles.
        digest: of that simulation.
        checkpoints: folder of the files from which interrupted seeds go on.
        prefix: with which the names of these begin.
        start_from: the policies that seeds begin with; those that have none there begin from nothing.
        randomisation: what differs from roll-out to roll-out; None: nothing.
        arena: where they drive; None: the arena of the simulation.

    Raises:
        UserError: the starts leave no steps to the one that goes on.
    """
    begun = start_from or {}
    first = PolicyJob(
        robot=options.robot,
        task=task,
        algorithm=algorithm,
        schedule=Schedule.of(options, algorithm.steps),
        simulation=simulation,
        digest=digest,
        seed=options.seed,
        checkpoint=None,
        sampled=options.sampled,
        device=options.device,
        tabulated=options.tabulated,
        table=options.table,
        randomisation=randomisation,
        arena=arena,
    )
    return [
        first._replace(
            seed=seed,
            checkpoint=checkpoints / f"{prefix}seed-{seed}.ckpt",
            initial=begun.get(seed),
        )
        for seed in options.all_seeds
    ]


def learn_all(
    jobs: Sequence[PolicyJob], report: LearningReport | None = None, processes: int | None = None
) -> list[SeedResult]:
    """Learn with all seeds, `processes` at a time; None: as many as there are cores."""
    results = run_side_by_side(jobs, report, processes)
    for result in results:
        if result.failed:
            log.warning("seed %d has failed: %s", result.seed, result.failed)
    return results


def best_of(results: Sequence[SeedResult]) -> SeedResult:
    """Return the seed with most success in the final scenarios, of equal ones that with the highest reward.

    Raises:
        UserError: every seed has failed.
    """
    usable = [(result.best.rank, result) for result in results if result.best and not result.failed]
    if not usable:
        reasons = "; ".join(f"seed {result.seed}: {result.failed}" for result in results)
        raise UserError(f"every seed has failed ({reasons}): learn longer, try other seeds, or another algorithm")
    return max(usable, key=lambda ranked: ranked[0])[1]
