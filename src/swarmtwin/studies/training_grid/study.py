"""A grid of trainings measured on recordings, and a view on it: tables 1 to 4 and figures 7 to 13 of the paper.

Each is a file in conf/experiment/ that says `study: training_grid`: which models learn from which data, what the paper
claims of them, what it states, and what is drawn. All share one store of finished trainings.
"""

import time
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import pandas as pd
from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeElapsedColumn

from swarmtwin.files import check_output, new_folder, write_text
from swarmtwin.learning.device import torch_device
from swarmtwin.learning.parallel import run_side_by_side
from swarmtwin.learning.progress_bars import quieter
from swarmtwin.simulation.evaluation import Measured
from swarmtwin.simulation.open_loop import open_loop
from swarmtwin.simulation.open_loop_storage import save_open_loop
from swarmtwin.simulation.simulation import Simulation
from swarmtwin.studies.tracked_inputs import recording_input, split_inputs
from swarmtwin.studies.training_grid.grid_data import GridData
from swarmtwin.studies.training_grid.grid_plots import draw_grid
from swarmtwin.studies.training_grid.options import Options
from swarmtwin.studies.training_grid.report import report_text
from swarmtwin.studies.training_grid.result_table import brief_table, shown_table, training_rows
from swarmtwin.studies.training_grid.summary import Summary, summarise
from swarmtwin.studies.training_grid.table_file import read_table
from swarmtwin.studies.training_grid.training_jobs import GeneratorJob, MeasuredTrainingJob, planned_jobs
from swarmtwin.studies.training_grid.training_store import TrainingStore
from swarmtwin.studies.training_grid.trainings import Training
from swarmtwin.tracking.runs import TrackedRun, tracked_run
from swarmtwin.transitions.inputs import Vehicles, read_vehicles, training_transitions

__all__ = ["Options", "run"]


def run(options: Options) -> dict[str, Any]:
    """Train and measure what is not in the store, save table, pictures and report; return how many claims hold.

    Raises:
        UserError: a recording, a model or a generator is missing or at fault, there are too few real transitions, or
            the output is taken.
        KeyboardInterrupt: it says that finished trainings are kept.
    """
    torch_device(options.device)
    models, generators = options.model_configs(), options.generator_configs()
    recordings = _recordings(options)
    settings = options.model_dump(mode="json")
    inputs = [folder for folder, _ in recordings.values()]
    check_output(options.output, "experiment", options.overwrite, [*inputs, options.store])
    transitions, preparation, _ = training_transitions(
        options.robot, None, options.train_vehicle, options.train_vehicles, options.split
    )
    data = GridData((transitions, preparation), models, generators, options.recipe, options.size.steps)
    measured = {
        name: Measured.of(read_vehicles(folder, options.robot, vehicles), folder)
        for name, (folder, vehicles) in recordings.items()
    }
    given = [
        *split_inputs(options.train_vehicle, transitions),
        *(recording_input(recordings[name][0], "test", one.recording) for name, one in measured.items()),
    ]
    title = f"{options.title}: {options.robot.title}"
    with (
        new_folder(options.output, "experiment", settings, options.overwrite, inputs=inputs) as folder,
        tracked_run("dynamics", f"{options.robot.name} {options.name}", settings, given, options.seed) as tracked,
    ):
        began = time.monotonic()
        jobs = _done(options, data, measured)
        summary = _save(folder, options, title, jobs, time.monotonic() - began)
        _track(tracked, read_table(folder / "table.csv"), summary)
        tracked.folder(folder, options.name)
    _show(options, title, summary)
    held = [claim.judged.verdict for claim in summary.claims].count("holds")
    return {"claims_held": held, "claims": len(summary.claims), "output": str(options.output)}


def _recordings(options: Options) -> dict[str, tuple[Path, Vehicles]]:
    """Return the recordings to measure on by what they are for, each with the vehicles of it that are looked at."""
    recordings: dict[str, tuple[Path, Vehicles]] = {
        "train_vehicle": (options.train_vehicle, options.train_vehicles),
        "other_vehicle": (options.other_vehicle, options.other_vehicles),
    }
    return recordings | ({"open_loop": (options.open_loop, None)} if options.open_loop else {})


def _done(options: Options, data: GridData, measured: Mapping[str, Measured]) -> list[MeasuredTrainingJob]:
    """Return every seed of every training, trained and measured: what is not in the store is made here."""
    store = TrainingStore(options.store.absolute())
    jobs, generators = planned_jobs(data, measured, store, options.grid, options.seeds, options.device)
    missing = list({job.key: job for job in jobs if not job.is_done}.values())
    wanted = {job.made_of.get("generator") for job in missing if not store.has(job.key)}
    untrained = [job for job in generators if job.key in wanted and not store.has(job.key)]
    columns = (TextColumn("{task.description}"), BarColumn(), MofNCompleteColumn(), TimeElapsedColumn())
    try:
        with Progress(*columns, console=Console(stderr=True)) as bars, quieter("swarmtwin.files"):
            _run_all(bars, f"{options.name}: generators", untrained, options.processes)
            _run_all(bars, f"{options.name}: trainings", missing, options.processes)
    except KeyboardInterrupt:
        raise KeyboardInterrupt(f"finished trainings are kept in {options.store}, the same call goes on") from None
    return jobs


def _run_all(
    bars: Progress, name: str, jobs: Sequence[GeneratorJob] | Sequence[MeasuredTrainingJob], processes: int | None
) -> None:
    if jobs:
        task = bars.add_task(name, total=len(jobs))
        run_side_by_side(jobs, lambda *_: bars.advance(task), processes)


def _save(folder: Path, options: Options, title: str, jobs: Sequence[MeasuredTrainingJob], taken_s: float) -> Summary:
    """Write table.csv, metrics.json, runs predicted open loop, pictures and report.md."""
    by_training: dict[Training, list[MeasuredTrainingJob]] = {}
    for job in jobs:
        by_training.setdefault(job.training, []).append(job)
    published = options.published.get(options.robot.name, ())
    rows: list[dict[str, Any]] = []
    by_run: dict[Training, dict[str, dict[int, Any]]] = {}
    for training, own in by_training.items():
        errors = {job.seed: found for job in own if (found := job.errors()) is not None}
        outcomes = [job.store.outcome(job.key) for job in own]
        names = list(own[0].measured)
        rows += training_rows(training, outcomes, errors, names, own[0].data.count, published)
        by_run[training] = {name: {seed: one[name].by_run for seed, one in errors.items()} for name in names}
    pd.DataFrame(rows).to_csv(folder / "table.csv", index=False, float_format="%.6g")
    summary = summarise(options, jobs, by_run, taken_s)
    write_text(folder / "metrics.json", summary.model_dump_json(indent=1) + "\n")
    if options.open_loop:
        _save_open_loop(folder / "open_loop", by_training)
    if options.pictures:
        draw_grid(folder, folder)
    table = shown_table(read_table(folder / "table.csv"), title)
    pictures = [file.name for file in sorted(folder.glob("*.png"))]
    text = report_text(title, options.shows, summary.about, table, summary.claims, summary.enough, pictures)
    write_text(folder / "report.md", text)
    return summary


def _save_open_loop(folder: Path, by_training: Mapping[Training, Sequence[MeasuredTrainingJob]]) -> None:
    """Write the runs kept for open loop as the first live seed of each training predicts them."""
    folder.mkdir()
    for training, jobs in by_training.items():
        live = next((job for job in jobs if job.store.outcome(job.key).dead is None), None)
        dynamics = live.store.model(live.key, live.seed).dynamics if live else None
        if live and dynamics:
            recording = live.measured["open_loop"].recording
            runs = open_loop(Simulation(dynamics), recording.tracks)
            save_open_loop(folder / f"{training.title(live.data.count)}.parquet", runs, recording.header.arena_mm)


def _track(tracked: TrackedRun, table: pd.DataFrame, summary: Summary) -> None:
    kept = ("position_mm", "orientation_deg", "model_error_position_mm", "open_loop_mm")
    for row in table.to_dict("records"):
        prefix = f"{_plain(str(row['title']))}/{row['recording']}"
        figures = {f"{prefix}/{name}": row[name] for name in kept if pd.notna(row.get(name))}
        tracked.metrics({**figures, f"{prefix}/dead_seeds": row["dead_seeds"]})
    tracked.note("\n".join(f"{claim.says} ({claim.where}): {claim.conclusion}" for claim in summary.claims))


def _plain(title: str) -> str:
    """Return a title without the signs that MLflow takes in no metric's name."""
    return "".join(sign if sign.isalnum() or sign in "-_. /" else " " for sign in title).strip()


def _show(options: Options, title: str, summary: Summary) -> None:
    console = Console()
    console.print(brief_table(read_table(options.output / "table.csv"), title).drawn())
    console.print("in brackets: standard deviation over seeds", style="dim")
    for claim in summary.claims:
        console.print(f"{claim.says} ({claim.where}): {claim.conclusion}", highlight=False, soft_wrap=True)
    for one in summary.enough:
        console.print(one.sentence, highlight=False, soft_wrap=True)
    console.print(f"table, report and pictures: {options.output}", highlight=False, soft_wrap=True)
