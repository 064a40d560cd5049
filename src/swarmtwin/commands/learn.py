"""`swarmtwin learn`: a policy is learned in the simulated world, tracked, and registered as challenger."""

import shutil
import time
from collections.abc import Sequence
from pathlib import Path
from typing import Annotated, Any

from pydantic import Field
from rich.console import Console
from rich.table import Table

from swarmtwin.files import check_output, new_folder, output_folder
from swarmtwin.learning.device import Device, torch_device
from swarmtwin.learning.progress_bars import training_bars
from swarmtwin.policies.algorithm import AlgorithmConfig, algorithm_config
from swarmtwin.policies.learned_folder import origin_of, save_learned
from swarmtwin.policies.policy_folder import PolicyProvenance
from swarmtwin.policies.reward_plots import draw_learning
from swarmtwin.policies.training import (
    PolicyJob,
    Schedule,
    SeedResult,
    learn_all,
    task_in,
)
from swarmtwin.robot import Robot, Seed, StrictModel
from swarmtwin.tracking import registry
from swarmtwin.tracking.runs import TrackedRun, tracked_run
from swarmtwin.world.task import Task, task_config


class Options(StrictModel):
    """Options of `swarmtwin learn`; their defaults stand in conf/learn.yaml."""

    robot: Robot
    task: dict[str, Any]
    policy: dict[str, Any]
    simulation: str | None
    evaluate_every: Annotated[int, Field(ge=1)]
    scenes: Annotated[int, Field(ge=1)]
    sampled: bool | None
    device: Device
    seed: Seed
    seeds: Annotated[int, Field(ge=1)]
    register_model: Annotated[bool, Field(alias="register")]
    pictures: bool
    output: Path | None
    overwrite: bool


def run(options: Options) -> None:
    """Learn, save the policy's folder, track the run and register the policy.

    Raises:
        UserError: no such simulation, task or algorithm, they do not fit each other, every seed failed, or the output
            is taken.
    """
    algorithm = algorithm_config(options.policy, "policy")
    task_to_learn = task_config(options.task, "task")
    source, simulation = _simulation(options)
    task = task_in(simulation, options.robot, task_to_learn, options.sampled)
    torch_device(options.device)
    origin = origin_of(source, simulation)
    name = f"{options.robot.name}-{task.config.name}-{algorithm.name}"
    output = output_folder(options.output, "learn", f"{name}-seed{options.seed}")
    settings = options.model_dump(mode="json", by_alias=True)
    check_output(output, "learn", options.overwrite, [simulation])
    with tracked_run("policy", name, settings, [simulation], options.seed) as tracked:
        started = time.monotonic()
        with new_folder(output, "learn", settings, options.overwrite, keep_partial=True, inputs=[simulation]) as folder:
            jobs = _jobs(options, task, algorithm, simulation, origin.digest, folder / "checkpoints")
            with training_bars(name, algorithm.steps) as report:
                results = learn_all(jobs, report)
            provenance = save_learned(folder, task, jobs[0], results, origin)
            if options.pictures:
                draw_learning(folder, folder)
            shutil.rmtree(folder / "checkpoints", ignore_errors=True)
        _track(tracked, results, provenance, time.monotonic() - started)
        kept = tracked.folder(output, "policy")
        registered = "not registered"
        if options.register_model:
            tags = provenance.tags(task.config.name)
            version = registry.register(f"{options.robot.name}-policy", output, kept, tracked.run_id, tags)
            registered = f"registered as {version}, its challenger"
    Console().print(_table(name, provenance))
    Console().print(f"{output}: {registered}", highlight=False, soft_wrap=True)


def _simulation(options: Options) -> tuple[str, Path]:
    """Return the simulation as it was named, and its folder; where none was, the pipeline's."""
    if options.simulation:
        return options.simulation, registry.model_folder(options.simulation)
    folder = Path("artifacts/dynamics") / options.robot.name / "crnet_synthetic"
    return str(folder), folder


def _jobs(
    options: Options, task: Task, algorithm: AlgorithmConfig, simulation: Path, digest: str, checkpoints: Path
) -> list[PolicyJob]:
    checkpoints.mkdir(exist_ok=True)
    schedule = Schedule(steps=algorithm.steps, evaluate_every=options.evaluate_every, scenes=options.scenes)
    return [
        PolicyJob(
            robot=options.robot,
            task=task.config,
            algorithm=algorithm,
            schedule=schedule,
            simulation=simulation,
            digest=digest,
            seed=seed,
            checkpoint=checkpoints / f"seed-{seed}.ckpt",
            sampled=options.sampled,
            device=options.device,
        )
        for seed in range(options.seed, options.seed + options.seeds)
    ]


def _track(tracked: TrackedRun, results: Sequence[SeedResult], provenance: PolicyProvenance, seconds: float) -> None:
    evaluation = provenance.evaluation.model_dump(exclude={"step"})
    tracked.metrics({f"evaluation_{name}": value for name, value in evaluation.items()})
    tracked.metrics({"training_s": seconds, "failed_seeds": sum(result.failed is not None for result in results)})
    best = next(result for result in results if result.seed == provenance.seed)
    tracked.history((evaluation.step, evaluation.model_dump(exclude={"step"})) for evaluation in best.history)
    tracked.tag("simulation.digest", provenance.simulation.digest)
    tracked.tag("simulation.origin", provenance.simulation.origin)


def _table(name: str, provenance: PolicyProvenance) -> Table:
    table = Table(
        "seed", "success", "reward", "collisions", "best step", "", title=f"{name}: in the evaluation scenarios"
    )
    for outcome in provenance.seeds:
        remark = f"failed: {outcome.failed}" if outcome.failed else ""
        if outcome.seed == provenance.seed:
            remark = "the policy"
        best = outcome.best
        cells = [f"{best.success:.0%}", f"{best.reward:.2f}", f"{best.collision:.0%}", str(best.step)] if best else []
        table.add_row(str(outcome.seed), *(cells or [""] * 4), remark)
    for column in table.columns[:5]:
        column.justify = "right"
    return table
