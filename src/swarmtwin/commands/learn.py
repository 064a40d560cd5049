"""`swarmtwin learn`: a policy is learned in the simulated world, tracked and registered; a better one challenges."""

import json
import time
from collections.abc import Sequence
from pathlib import Path
from typing import Annotated, Any

from pydantic import Field
from rich.console import Console
from rich.table import Table

from swarmtwin.diagnosis.measured_ranges import chosen_randomisation
from swarmtwin.files import CHECKPOINTS, new_folder, output_folder
from swarmtwin.learning.device import torch_device
from swarmtwin.learning.progress_bars import training_bars
from swarmtwin.policies.algorithm import AlgorithmConfig, algorithm_config
from swarmtwin.policies.initial_policy import InitialPolicy
from swarmtwin.policies.learned_folder import origin_of, save_learned
from swarmtwin.policies.policy_folder import PolicyProvenance, StoredPolicy, load_policy
from swarmtwin.policies.reward_plots import draw_learning
from swarmtwin.policies.rollout_comparison import Evaluation, draw_scenarios
from swarmtwin.policies.seeds import LearningOptions, learn_all, policy_jobs
from swarmtwin.policies.training import (
    LearningReport,
    PolicyJob,
    SeedResult,
    task_in,
)
from swarmtwin.robot import Arena
from swarmtwin.simulation.displacement_table import DisplacementTable, TableError, tabulated
from swarmtwin.simulation.simulation_folder import load_simulation
from swarmtwin.tracking import registry
from swarmtwin.tracking.datasets import Dataset
from swarmtwin.tracking.gate import Trials, judge_challenging_policy
from swarmtwin.tracking.model_source import model_folder
from swarmtwin.tracking.runs import TrackedRun, tracked_run
from swarmtwin.world.randomised_motion import motion_in
from swarmtwin.world.rollout import NEVER, Rate, play
from swarmtwin.world.task import Task, task_config


class Options(LearningOptions):
    """Options of `swarmtwin learn`; their defaults stand in conf/learn.yaml."""

    arena_mm: Arena | None
    simulation: str | None
    start_from: str | None
    randomisation: dict[str, Any] | str | None
    draws: Annotated[int, Field(ge=1)]
    register_model: Annotated[bool, Field(alias="register")]
    pictures: bool
    output: Path | None
    overwrite: bool


def run(options: Options) -> dict[str, Any]:
    """Learn, save the policy's folder, track the run and register the policy; return how it did in evaluation.

    Raises:
        UserError: no such simulation, task or algorithm, they do not fit each other, every seed failed, or the output
            is taken.
    """
    algorithm = algorithm_config(options.policy, "policy")
    task_to_learn = task_config(options.task, "task")
    source, simulation = _simulation(options)
    task = task_in(simulation, options.robot, task_to_learn, options.sampled, options.arena_mm)
    torch_device(options.device)
    table = _table_of(simulation, options)
    randomisation = chosen_randomisation(options.randomisation, load_simulation(simulation), options.draws)
    start_from = _start_from(options, task, algorithm)
    origin = origin_of(source, simulation)
    name = f"{options.robot.name}-{task.config.name}-{algorithm.name}"
    output = output_folder(options.output, "learn", f"{name}-seed{options.seed}")
    settings = options.model_dump(mode="json", by_alias=True)
    inputs = [Dataset(simulation, "simulation", origin.digest)]
    if isinstance(options.randomisation, str):
        inputs.append(Dataset.of_files(Path(options.randomisation), "diagnosis"))
    if options.start_from is not None:
        inputs.append(Dataset.of_files(model_folder(options.start_from), "policy"))
    with (
        new_folder(
            output, "learn", settings, options.overwrite, resumable=True, inputs=[one.folder for one in inputs]
        ) as folder,
        tracked_run("policy", name, settings, inputs, options.seed) as tracked,
    ):
        started = time.monotonic()
        about = (algorithm, task.config, simulation, origin.digest, folder / CHECKPOINTS, "")
        jobs = policy_jobs(options, *about, start_from, randomisation, options.arena_mm)
        with training_bars(name, jobs[0].schedule.all_steps) as report:
            results = learn_all(jobs, _tracking(tracked, report))
        provenance = save_learned(folder, task, jobs[0], results, origin)
        if options.pictures:
            draw_learning(folder, folder)
            for name in ("history.png", "rollout.mp4"):
                tracked.picture(folder / name)
        _track(tracked, results, provenance, time.monotonic() - started)
        if table:
            tracked.metrics({"table_position_mm": table.position_mm, "table_heading_deg": table.heading_deg})
        kept = tracked.model(folder, "policy")
        registered = "not registered"
        if options.register_model:
            tags = provenance.tags(task.config.name)
            version = registry.register(f"{options.robot.name}-policy", folder, kept, tracked.run_id, tags)
            registered = _challenge(options, version, folder, task, jobs[0])
    Console().print(_table(name, provenance))
    Console().print(_how_good(output), highlight=False, soft_wrap=True)
    if table:
        off = f"{table.position_mm:.2g} mm and {table.heading_deg:.2g}° off it (99 % of random commands)"
        told = f"learned in a table of the simulation, {off}; tabulated=false: in the simulation itself"
        Console().print(told, highlight=False, soft_wrap=True)
    Console().print(f"{output}: {registered}", highlight=False, soft_wrap=True)
    return {**_evaluation(provenance), "output": str(output)}


def _simulation(options: Options) -> tuple[str, Path]:
    """Return the simulation as it was named, and its folder; where none was, the pipeline's."""
    if options.simulation:
        return options.simulation, model_folder(options.simulation)
    folder = Path("artifacts/dynamics") / options.robot.name / "crnet_synthetic"
    return str(folder), folder


def _start_from(options: Options, task: Task, algorithm: AlgorithmConfig) -> dict[int, InitialPolicy]:
    """Return the policy that each seed goes on from; nothing: all begin from nothing.

    Raises:
        UserError: there is none, it is of another robot, looks at other numbers or has another network.
    """
    if options.start_from is None:
        return {}
    stored = load_policy(model_folder(options.start_from), options.robot)
    return dict.fromkeys(options.all_seeds, InitialPolicy.of(options.start_from, stored, task, algorithm))


def _table_of(simulation: Path, options: Options) -> TableError | None:
    """Return how far the table is off that policies are learned in; None where they are not learned in one.

    Raises:
        UserError: a table is asked for, and there can be none.
    """
    dynamics = tabulated(load_simulation(simulation), options.table, options.tabulated).dynamics
    return dynamics.error if isinstance(dynamics, DisplacementTable) else None


def _challenge(options: Options, version: registry.Version, output: Path, task: Task, job: PolicyJob) -> str:
    """Make a policy challenger if it is measurably better, in the simulation that it was learned in; say what was done.

    Both are rolled out from the same starts, none of which any policy was learned or chosen by.
    """
    scenarios = draw_scenarios(task, options.scenes, "challenge", seed=0)
    loaded = load_simulation(job.simulation)

    def trials(policy: StoredPolicy) -> Trials:
        motion = motion_in(loaded, len(scenarios), task.vehicles, job.sampled, 0, job.randomisation)
        rollout = play(task, motion, scenarios, policy.policy.act)
        return Trials(rollout.success, rollout.collided_step != NEVER, rollout.mean_reward)

    def compare(challenger: registry.Version) -> tuple[bool, str]:
        rival = load_policy(challenger.folder(), options.robot)
        if rival.task != task.config:
            return True, "not compared, since its task has other settings"
        verdict = judge_challenging_policy(trials(load_policy(output)), trials(rival))
        return verdict.passed, str(verdict)

    return registry.challenge(version, compare)


def _tracking(tracked: TrackedRun, report: LearningReport) -> LearningReport:
    """Return a report that also keeps each seed's evaluations with the run, as soon as they are there."""
    kept: dict[int, int] = {}

    def report_and_track(seed: int, done: int, latest: Evaluation | None) -> None:
        report(seed, done, latest)
        if latest and latest.step > kept.get(seed, 0):
            kept[seed] = latest.step
            figures = {f"seed_{seed}_success": latest.success, f"seed_{seed}_reward": latest.reward}
            tracked.metrics(figures, latest.step)

    return report_and_track


def _track(tracked: TrackedRun, results: Sequence[SeedResult], provenance: PolicyProvenance, seconds: float) -> None:
    tracked.metrics(_evaluation(provenance))
    tracked.metrics({"training_s": seconds, "failed_seeds": sum(result.failed is not None for result in results)})
    best = next(result for result in results if result.seed == provenance.seed)
    tracked.history((evaluation.step, evaluation.model_dump(exclude={"step"})) for evaluation in best.history)
    tracked.tag("simulation.digest", provenance.simulation.digest)
    tracked.tag("simulation.origin", provenance.simulation.origin)
    if provenance.randomisation:
        tracked.tag("randomisation", json.dumps(provenance.randomisation["mechanisms"]))


def _evaluation(provenance: PolicyProvenance) -> dict[str, float]:
    return {f"evaluation_{name}": figure for name, figure in provenance.evaluation.model_dump(exclude={"step"}).items()}


def _how_good(output: Path) -> str:
    """Say how good the policy is in scenarios by which nothing was chosen."""
    test = json.loads((output / "metrics.json").read_text())["test"]
    told = []
    for name in ("success", "collision", "left_arena"):
        rate = Rate(**test[name])
        share = f"{100 * rate.value:.1f} % ({100 * rate.low:.1f} to {100 * rate.high:.1f})"
        told.append(f"{name.replace('_', ' ')} {share}")
    reward = test["reward"]
    told.append(f"reward {reward['mean']:.2f} ± {reward['sd']:.2f}")
    return f"the policy in {test['rollouts']} new scenarios: {', '.join(told)}"


def _table(name: str, provenance: PolicyProvenance) -> Table:
    table = Table("seed", "success", "reward", "collisions", "best step", "", title=f"{name}: in the final scenarios")
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
