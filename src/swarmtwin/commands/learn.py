"""`swarmtwin learn`: a policy is learned in the simulated world, tracked, and registered as challenger."""

import json
import shutil
import time
from collections.abc import Sequence
from pathlib import Path
from typing import Annotated, Any

import pandas as pd
from pydantic import Field
from rich.console import Console
from rich.table import Table

from swarmtwin import registry
from swarmtwin.commands.measurement import load_simulation
from swarmtwin.commands.outputs import output_folder
from swarmtwin.commands.progress import learning_bars
from swarmtwin.errors import UserError
from swarmtwin.files import check_output, new_folder, write_text
from swarmtwin.policies.algorithm import AlgorithmConfig
from swarmtwin.policies.figures import history_figure
from swarmtwin.policies.learning import Lesson, Schedule, SeedResult, check_task
from swarmtwin.policies.provenance import Evaluated, PolicyProvenance, SeedOutcome, SimulationOrigin
from swarmtwin.policies.registry import algorithm_config
from swarmtwin.policies.seeds import best_of, learn_all, policy_of
from swarmtwin.policies.store import save_policy
from swarmtwin.robot import Robot, Seed, StrictModel
from swarmtwin.tracking import TrackedRun, tracked_run
from swarmtwin.world.registry import task_config
from swarmtwin.world.task import TaskConfig

CHECKPOINTS = "checkpoints"
PIPELINE_SIMULATION = "crnet_synthetic"


class Options(StrictModel):
    """Options of `swarmtwin learn`; their defaults stand in conf/learn.yaml."""

    robot: Robot
    task: dict[str, Any]
    policy: dict[str, Any]
    simulation: str | None
    evaluate_every: Annotated[int, Field(ge=1)]
    scenes: Annotated[int, Field(ge=1)]
    seed: Seed
    seeds: Annotated[int, Field(ge=1)]
    register_model: Annotated[bool, Field(alias="register")]
    output: Path | None
    overwrite: bool


def run(options: Options) -> None:
    """Learn, save the policy's folder, track the run and register the policy.

    Raises:
        UserError: no such simulation, task or algorithm, they do not fit each other, every seed failed, or the output
            is taken.
    """
    algorithm = algorithm_config(options.policy, "policy")
    task = task_config(options.task, "task")
    source, simulation = _simulation(options)
    check_task(options.robot, task, simulation)
    origin = _origin(source, simulation, options.robot)
    name = f"{options.robot.name}-{task.name}-{algorithm.name}"
    output = output_folder(options.output, "learn", f"{name}-seed{options.seed}")
    settings = options.model_dump(mode="json", by_alias=True)
    check_output(output, "learn", options.overwrite, [simulation])
    with tracked_run("policy", name, settings, [simulation], options.seed) as tracked:
        started = time.monotonic()
        with new_folder(output, "learn", settings, options.overwrite, keep_partial=True, inputs=[simulation]) as folder:
            lessons = _lessons(options, task, algorithm, simulation, origin.digest, folder / CHECKPOINTS)
            with learning_bars(name, algorithm.steps) as report:
                results = learn_all(lessons, report)
            provenance = _save(folder, lessons, results, origin)
        _track(tracked, results, provenance, time.monotonic() - started)
        kept = tracked.folder(output, "policy")
        registered = "not registered"
        if options.register_model:
            tags = provenance.tags(task.name)
            version = registry.register(f"{options.robot.name}-policy", output, kept, tracked.run_id, tags)
            registered = f"registered as {version}, its challenger"
    Console().print(_table(name, provenance))
    Console().print(f"{output}: {registered}", highlight=False, soft_wrap=True)


def _simulation(options: Options) -> tuple[str, Path]:
    """Return the simulation as it was named, and its folder; where none was, the pipeline's."""
    if options.simulation:
        return options.simulation, registry.model_folder(options.simulation)
    folder = Path("artifacts/dynamics") / options.robot.name / PIPELINE_SIMULATION
    if not folder.is_dir():
        raise UserError(f"no simulation in {folder}: run `dvc repro` first, or give simulation=...")
    return str(folder), folder


def _origin(source: str, simulation: Path, robot: Robot) -> SimulationOrigin:
    dynamics, provenance = load_simulation(simulation, robot)
    return SimulationOrigin(
        source=source,
        model=dynamics.config.name,
        digest=registry.folder_digest(simulation),
        recording=provenance.recording,
        origin=provenance.origin,
    )


def _lessons(
    options: Options, task: TaskConfig, algorithm: AlgorithmConfig, simulation: Path, digest: str, checkpoints: Path
) -> list[Lesson]:
    checkpoints.mkdir(exist_ok=True)
    schedule = Schedule(steps=algorithm.steps, evaluate_every=options.evaluate_every, scenes=options.scenes)
    return [
        Lesson(options.robot, task, algorithm, schedule, simulation, digest, seed, checkpoints / f"seed-{seed}.ckpt")
        for seed in range(options.seed, options.seed + options.seeds)
    ]


def _save(
    folder: Path, lessons: Sequence[Lesson], results: Sequence[SeedResult], origin: SimulationOrigin
) -> PolicyProvenance:
    lesson, best = lessons[0], best_of(results)
    outcomes = [
        SeedOutcome(seed=r.seed, best=Evaluated(**r.best._asdict()) if r.best else None, failed=r.failed)
        for r in results
    ]
    provenance = PolicyProvenance(
        simulation=origin,
        algorithm=lesson.algorithm.model_dump(mode="json"),
        schedule=lesson.schedule.model_dump(mode="json"),
        seed=best.seed,
        seeds=tuple(outcomes),
    )
    save_policy(folder, policy_of(lesson, best), lesson.task, provenance)
    metrics = {
        "evaluation": provenance.evaluation.model_dump(),
        "seeds": {str(outcome.seed): outcome.best.model_dump() if outcome.best else None for outcome in outcomes},
    }
    write_text(folder / "metrics.json", json.dumps(metrics, indent=1) + "\n")
    history = [{"seed": result.seed, **stage._asdict()} for result in results for stage in result.history]
    pd.DataFrame(history).to_csv(folder / "history.csv", index=False, float_format="%.5f")
    history_figure(results).savefig(folder / "history.png")
    shutil.rmtree(folder / CHECKPOINTS, ignore_errors=True)
    return provenance


def _track(tracked: TrackedRun, results: Sequence[SeedResult], provenance: PolicyProvenance, seconds: float) -> None:
    evaluation = provenance.evaluation.model_dump(exclude={"step"})
    tracked.metrics({f"evaluation_{name}": value for name, value in evaluation.items()})
    tracked.metrics({"training_s": seconds, "failed_seeds": sum(result.failed is not None for result in results)})
    best = next(result for result in results if result.seed == provenance.seed)
    tracked.history((stage.step, {k: v for k, v in stage._asdict().items() if k != "step"}) for stage in best.history)
    tracked.tag("simulation.digest", provenance.simulation.digest)
    tracked.tag("simulation.origin", provenance.simulation.origin)


def _table(name: str, provenance: PolicyProvenance) -> Table:
    table = Table("seed", "success", "reward", "collisions", "best step", "", title=f"{name}: in the evaluation scenes")
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
