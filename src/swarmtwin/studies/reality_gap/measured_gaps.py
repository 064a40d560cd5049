"""Learns a policy in each of several simulations, and measures how far each is from what stand-ins then do with it."""

import json
from collections.abc import Callable, Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import Any

import pandas as pd
from rich.console import Console

from swarmtwin.files import check_output, new_folder, write_text
from swarmtwin.policies.algorithm import algorithm_config
from swarmtwin.policies.rollout_comparison import check_count, draw_scenarios
from swarmtwin.recordings.reading import read_recording
from swarmtwin.recordings.recording import Recording
from swarmtwin.simulation.open_loop import open_loop
from swarmtwin.simulation.open_loop_storage import save_open_loop
from swarmtwin.studies.reality_gap.gap_plots import draw_gaps
from swarmtwin.studies.reality_gap.gap_rollouts import (
    LEARNED,
    RANDOM,
    SCRIPTED,
    PolicyRollouts,
    gap_metrics,
    gap_rows,
)
from swarmtwin.studies.reality_gap.gap_table import Line, gap_lines, gap_markdown, gap_table
from swarmtwin.studies.reality_gap.learned_policies import Candidate, Learned, learn_in, learning_table, load_candidates
from swarmtwin.studies.reality_gap.options import GapOptions
from swarmtwin.studies.reality_gap.same_starts import (
    MakeMotion,
    RandomCommands,
    roll_out_everywhere,
    stand_in_motions,
)
from swarmtwin.studies.tracked_inputs import recording_input
from swarmtwin.tracking.datasets import Dataset
from swarmtwin.tracking.runs import TrackedRun, tracked_run
from swarmtwin.world.motion import SimulatedMotion
from swarmtwin.world.rollout import Act
from swarmtwin.world.scripted import ScriptedPolicy
from swarmtwin.world.task import Task


def measure_gaps(options: GapOptions, title: str) -> dict[str, Any]:
    """Learn and roll out, save table, roll-outs, policies and pictures, show the table; return gaps and successes.

    Raises:
        UserError: a simulation or recording is missing or of another robot, it does not fit the task, the stand-ins do
            not, there are too few roll-outs, or the output is taken.
    """
    check_count(options.rollouts)
    algorithm_config(options.policy, "policy")
    settings = options.model_dump(mode="json")
    candidates = load_candidates(options)
    task = candidates[0].task
    real = stand_in_motions(options.stand_ins, task, options.rollouts, options.seed)
    ScriptedPolicy(task)
    recording = read_recording(options.open_loop, options.robot) if options.open_loop else None
    inputs = [candidate.folder for candidate in candidates] + ([options.open_loop] if options.open_loop else [])
    check_output(options.output, "experiment", options.overwrite, inputs)
    title = f"{title}: {options.robot.title}, task {task.config.name}"
    with (
        new_folder(options.output, "experiment", settings, options.overwrite, resumable=True, inputs=inputs) as folder,
        tracked_run("transfer", title, settings, _given(options, candidates, recording), options.seed) as tracked,
    ):
        learned = {candidate.name: learn_in(candidate, options, folder) for candidate in candidates}
        rollouts = _all_rollouts(options, candidates, learned, real)
        _save(folder, options, candidates, learned, rollouts)
        if recording:
            _save_open_loop(folder / "open_loop", candidates, recording)
        if options.pictures:
            draw_gaps(folder, folder)
        table = pd.read_csv(folder / "table.csv")
        lines = _lines(options, table, task, learned)
        pictures = sorted(file.name for file in folder.glob("*.png"))
        write_text(folder / "report.md", gap_markdown(title, lines, options.rollouts, pictures))
        _track(tracked, table)
        tracked.folder(folder, "reality_gap")
    Console().print(gap_table(title, lines, options.rollouts))
    Console().print(f"table, roll-outs, policies and pictures: {options.output}", highlight=False, soft_wrap=True)
    return {**_headline(table), "output": str(options.output)}


def _given(options: GapOptions, candidates: Sequence[Candidate], recording: Recording | None) -> list[Dataset]:
    simulations = [Dataset(candidate.folder, "simulation", candidate.origin.digest) for candidate in candidates]
    if recording is None or options.open_loop is None:
        return simulations
    return [*simulations, recording_input(options.open_loop, "test", recording)]


def _all_rollouts(
    options: GapOptions,
    candidates: Sequence[Candidate],
    learned: Mapping[str, Learned],
    real: Mapping[str, MakeMotion],
) -> list[PolicyRollouts]:
    """Roll out the learned policies, each in its own simulation, and the baselines in all; all of them on stand-ins."""
    task = candidates[0].task
    scenario = draw_scenarios(task, options.rollouts, "rollout", options.seed)
    simulated: dict[str, MakeMotion] = {
        candidate.name: partial(
            SimulatedMotion, candidate.simulation, options.rollouts, task.vehicles, options.sampled, options.seed
        )
        for candidate in candidates
    }
    everywhere = partial(roll_out_everywhere, task, scenario)
    rollouts = []
    for name, one in learned.items():
        if one.policy:
            begin = partial(_as_is, one.policy.act)
            rollouts.append(
                PolicyRollouts(LEARNED, everywhere({name: simulated[name]}, begin), everywhere(real, begin))
            )
    baselines: dict[str, Callable[[], Act]] = {
        SCRIPTED: partial(_as_is, ScriptedPolicy(task).act),
        RANDOM: partial(_random_commands, options),
    }
    for name, start in baselines.items():
        rollouts.append(PolicyRollouts(name, everywhere(simulated, start), everywhere(real, start)))
    return rollouts


def _as_is(act: Act) -> Act:
    return act


def _random_commands(options: GapOptions) -> Act:
    return RandomCommands(options.robot, options.seed).act


def _save(
    folder: Path,
    options: GapOptions,
    candidates: Sequence[Candidate],
    learned: Mapping[str, Learned],
    rollouts: Sequence[PolicyRollouts],
) -> None:
    table = pd.DataFrame([row for one in rollouts for row in gap_rows(one)])
    table.to_csv(folder / "table.csv", index=False)
    learning_table(learned).to_csv(folder / "learning.csv", index=False, float_format="%.5f")
    simulations = {
        candidate.name: {
            **candidate.origin.model_dump(),
            "failed": learned[candidate.name].failed,
            "policies": {
                one.policy: gap_metrics(one, candidate.name) for one in rollouts if candidate.name in one.simulated
            },
        }
        for candidate in candidates
    }
    about = {"robot": options.robot.name, "task": candidates[0].task.config.name, "rollouts": options.rollouts}
    write_text(folder / "metrics.json", json.dumps({**about, "simulations": simulations}, indent=1) + "\n")
    (folder / "rollouts").mkdir()
    for one in rollouts:
        one.save(folder / "rollouts")


def _lines(options: GapOptions, table: pd.DataFrame, task: Task, learned: Mapping[str, Learned]) -> list[Line]:
    failed = {name: one.failed for name, one in learned.items()}
    return gap_lines(table, failed, options.published.get(task.config.name, {}))


def _save_open_loop(folder: Path, candidates: Sequence[Candidate], recording: Recording) -> None:
    folder.mkdir()
    for candidate in candidates:
        runs = open_loop(candidate.simulation, recording.tracks)
        save_open_loop(folder / f"{candidate.name}.parquet", runs, recording.header.arena_mm)


def _track(tracked: TrackedRun, table: pd.DataFrame) -> None:
    for row in table.to_dict("records"):
        prefix = f"{row['simulation']}/{row['policy']}/{row['where']}"
        names = ("reward", "success", "collision", *(("gap",) if row["where"] != "simulation" else ()))
        tracked.metrics({f"{prefix}/{name}": row[name] for name in names})


def _headline(table: pd.DataFrame) -> dict[str, float]:
    """Return, of each policy learned, gap and success on average over the groups of stand-ins."""
    real = table[(table.policy == LEARNED) & (table["where"] != "simulation")]
    means = real.groupby("simulation", sort=False)[["gap", "success"]].mean()
    return {f"{name} {quantity}": float(mean) for quantity in means for name, mean in means[quantity].items()}
