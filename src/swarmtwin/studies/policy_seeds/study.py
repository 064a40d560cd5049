"""`swarmtwin experiment name=policy_seeds`: how many seeds of learning lead to a policy that is good enough."""

import json
from collections.abc import Sequence
from typing import Any

import pandas as pd
from rich.console import Console

from swarmtwin.diagnosis.measured_ranges import chosen_randomisation
from swarmtwin.files import check_output, new_folder, write_text
from swarmtwin.learning.parallel import run_side_by_side
from swarmtwin.learning.progress_bars import training_bars
from swarmtwin.policies.algorithm import algorithm_config
from swarmtwin.policies.learned_folder import history_table
from swarmtwin.policies.rollout_comparison import check_count
from swarmtwin.policies.seeds import best_of
from swarmtwin.studies.policy_seeds.options import SIMULATION, Options
from swarmtwin.studies.policy_seeds.seed_trial import SeedJob, SeedTrial
from swarmtwin.studies.policy_seeds.table import draw_seeds, reached, seeds_table
from swarmtwin.studies.reality_gap.gap_rollouts import figure_columns
from swarmtwin.studies.reality_gap.learned_policies import load_candidate
from swarmtwin.studies.reality_gap.same_starts import stand_in_motions
from swarmtwin.tracking.datasets import Dataset
from swarmtwin.tracking.runs import TrackedRun, tracked_run
from swarmtwin.world.rollout import Rate


def run(options: Options) -> dict[str, Any]:
    """Learn with all seeds and try them; save table, policies and the picture; return how many do as well as asked.

    Raises:
        UserError: the simulation is missing or of another robot, it does not fit the task or what is to differ in it,
            the stand-ins do not fit, there are too few roll-outs, no seed leads to a policy that can be tried, or the
            output is taken.
    """
    check_count(options.rollouts)
    algorithm = algorithm_config(options.policy, "policy")
    candidate = load_candidate(SIMULATION, options.simulation, options)
    randomisation = chosen_randomisation(options.randomisation, candidate.simulation, options.draws)
    stand_in_motions(options.stand_ins, candidate.task, options.rollouts, options.seed)
    settings = options.model_dump(mode="json")
    check_output(options.output, "experiment", options.overwrite, [candidate.folder])
    name = f"{options.robot.name}-{candidate.task.config.name}-{algorithm.name}"
    title = f"{algorithm.name.upper()}, {options.seeds} seeds: {options.robot.title}, task {candidate.task.config.name}"
    if "previous_command" in candidate.simulation.dynamics.inputs:
        title += ", in a simulation that is given the command before"
    if options.starts > 1:
        title += f", each the most promising of {options.starts} starts"
    given = [Dataset(candidate.folder, "simulation", candidate.origin.digest)]
    with (
        new_folder(
            options.output, "experiment", settings, options.overwrite, resumable=True, inputs=[candidate.folder]
        ) as folder,
        tracked_run("transfer", title, settings, given, options.seed) as tracked,
    ):
        jobs = [
            SeedJob(
                learning=learning,
                task=candidate.task,
                origin=candidate.origin,
                stand_ins=options.stand_ins,
                rollouts=options.rollouts,
                start_seed=options.seed,
                folder=folder / "policies" / f"seed-{learning.seed}",
            )
            for learning in candidate.jobs(options, folder, randomisation=randomisation)
        ]
        with training_bars(name, jobs[0].learning.schedule.all_steps) as report:
            trials = run_side_by_side(jobs, report, options.processes)
        if not any(trial.figures for trial in trials):
            best_of([trial.result for trial in trials])  # says why none can be tried
        table = pd.DataFrame([row for trial in trials for row in _rows(trial)])
        table.to_csv(folder / "table.csv", index=False, float_format="%.5f")
        history = history_table([trial.result for trial in trials])
        history.to_csv(folder / "learning.csv", index=False, float_format="%.5f")
        shown = seeds_table(title, table, options.asked)
        write_text(folder / "report.md", f"# {shown.markdown().removeprefix('## ')}\n![success](seeds.png)\n")
        metrics = _metrics(options, table, trials)
        write_text(folder / "metrics.json", json.dumps(metrics, indent=1) + "\n")
        draw_seeds(folder, folder, options.asked)
        headline = _headline(metrics)
        _track(tracked, table, headline)
        tracked.folder(folder, "policy_seeds")
    Console().print(shown.drawn())
    Console().print(f"table, policies and the picture: {options.output}", highlight=False, soft_wrap=True)
    return {**headline, "output": str(options.output)}


def _rows(trial: SeedTrial) -> list[dict[str, Any]]:
    """Return the lines of table.csv of a seed: one for each place where it was tried, or one that says why none was."""
    about = {"seed": trial.result.seed, "cpu_s": trial.cpu_s, "failed": trial.result.failed}
    tried = [{**about, "where": where, **figure_columns(figures)} for where, figures in trial.figures.items()]
    return tried or [{**about, "where": None}]


def _metrics(options: Options, table: pd.DataFrame, trials: Sequence[SeedTrial]) -> dict[str, Any]:
    does = reached(table, options.asked)
    rate = Rate.of(does.to_numpy())
    times = [trial.cpu_s for trial in trials if trial.cpu_s is not None]
    return {
        "robot": options.robot.name,
        "task": options.task["name"],
        "asked": options.asked,
        "seeds": len(does),
        "seeds_as_asked": int(does.sum()),
        "share_as_asked": rate._asdict(),
        "cpu_s": {"median": float(pd.Series(times).median()), "most": max(times)} if times else None,
        "success": {
            str(where): {str(seed): float(success) for seed, success in zip(own.seed, own.success, strict=True)}
            for where, own in table.dropna(subset="where").groupby("where")
        },
    }


def _headline(metrics: dict[str, Any]) -> dict[str, float]:
    worst = {f"least_success_{where}": min(by_seed.values()) for where, by_seed in metrics["success"].items()}
    return {"seeds_as_asked": metrics["seeds_as_asked"], "share_as_asked": metrics["share_as_asked"]["value"], **worst}


def _track(tracked: TrackedRun, table: pd.DataFrame, headline: dict[str, float]) -> None:
    tracked.metrics(headline)
    for seed, own in table.dropna(subset="where").groupby("seed"):
        tracked.metrics({f"seed_{seed}/{row['where']}_success": row["success"] for row in own.to_dict("records")})
