"""`swarmtwin experiment name=dynamics`: tables 1 and 2 of the paper, trained on real data, with what they lack.

Each model is measured on runs it has never seen, beside the noise floor, a plain MLP and the kinematic model.
"""

import json
import math
import shutil
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import pandas as pd
from rich.console import Console
from rich.table import Table

from swarmtwin.commands.evaluate import errors_text, tracked_figures
from swarmtwin.commands.measurement import Errors, Measurement, load_simulation, measure
from swarmtwin.dynamics import figures as plots
from swarmtwin.dynamics.provenance import Provenance
from swarmtwin.errors import UserError
from swarmtwin.files import new_folder, write_text
from swarmtwin.recordings.reading import read_recording
from swarmtwin.robot import Robot, StrictModel
from swarmtwin.tracking import tracked_run


class Options(StrictModel):
    """Options; their defaults stand in conf/experiment/dynamics.yaml."""

    name: Literal["dynamics"]
    robot: Robot
    models: Path
    recordings: dict[str, Path]
    output: Path
    overwrite: bool


@dataclass(frozen=True)
class Entry:
    """One trained model and how it measures on each recording."""

    name: str
    folder: Path
    parameters: int
    provenance: Provenance
    measurements: dict[str, Measurement]


def run(options: Options) -> None:
    """Measure all models, save table, pictures and the best of them, and show the table.

    Raises:
        UserError: there is no model, a recording is missing, or the output is taken.
    """
    settings = options.model_dump(mode="json")
    inputs = [options.models, *options.recordings.values()]
    with tracked_run("dynamics", f"{options.robot.name} models compared", settings, inputs) as tracked:
        with new_folder(options.output, "experiment", settings, options.overwrite) as folder:
            entries = _entries(options)
            best = best_entry(entries)
            _save(folder, entries, best)
        for entry in entries:
            for recording, measurement in entry.measurements.items():
                figures = tracked_figures(measurement.overall)
                tracked.metrics({f"{entry.name}/{recording}/{key}": value for key, value in figures.items()})
        tracked.tag("best_model", best.name)
        tracked.folder(options.output, "comparison")
    Console().print(comparison_table(options.robot.title, pd.read_csv(options.output / "table.csv"), best.name))


def best_entry(entries: Sequence[Entry]) -> Entry:
    """Return the model with the smallest errors on the validation runs, position and orientation weighed alike."""
    position = min(entry.provenance.chosen.position_mm for entry in entries)
    orientation = min(entry.provenance.chosen.orientation_deg for entry in entries)

    def score(entry: Entry) -> float:
        chosen = entry.provenance.chosen
        return chosen.position_mm / position + chosen.orientation_deg / orientation

    return min(entries, key=score)


def comparison_table(title: str, rows: pd.DataFrame, best: str) -> Table:
    """Return what a person reads: a row for each model, the floor first; ± is the standard deviation over transitions."""
    table = Table("model", "parameters", title=f"{title}: models trained on real data, errors on unseen runs")
    for recording in rows.recording.unique():
        table.add_column(f"{recording.replace('_', ' ')}\none-step")
    table.add_column("model error", justify="right")
    table.add_column("open loop\nRMSE", justify="right")
    table.add_column("dead\nseeds", justify="right")
    first = rows[rows.model == rows.model.iloc[0]]
    table.add_row(f"floor ({first.floor_kind.iloc[0].replace('_', ' ')})", "", *first.floor, "", "", "", style="dim")
    for model, part in rows.groupby("model", sort=False):
        name = f"{model} *" if model == best else str(model)
        last = part.iloc[-1]
        model_error = "" if pd.isna(last.model_error) else last.model_error
        dead = f"{last.dead_seeds} of {last.seeds}"
        table.add_row(name, f"{last.parameters:,}", *part.one_step, model_error, last.open_loop, dead)
    table.caption = "* best on the validation runs"
    return table


def _entries(options: Options) -> list[Entry]:
    if not options.models.is_dir():
        raise UserError(f"no folder {options.models} with models: run `dvc repro` first")
    folders = sorted(folder for folder in options.models.iterdir() if (folder / "model.yaml").exists())
    if not folders:
        raise UserError(f"{options.models} holds no model folder: run `dvc repro` first")
    recordings = {name: read_recording(folder, options.robot) for name, folder in options.recordings.items()}
    entries = []
    for folder in folders:
        dynamics, provenance = load_simulation(folder, options.robot)
        measurements = {
            name: measure(dynamics, provenance, recording, options.recordings[name])
            for name, recording in recordings.items()
        }
        parameters = sum(weights.numel() for weights in dynamics.parameters())
        entries.append(Entry(folder.name, folder, parameters, provenance, measurements))
    return sorted(entries, key=lambda entry: _one_step(entry), reverse=True)


def _one_step(entry: Entry) -> float:
    return next(iter(entry.measurements.values())).overall.one_step.position_mm.mean


def _save(folder: Path, entries: Sequence[Entry], best: Entry) -> None:
    metrics = {e.name: {name: m.metrics() for name, m in e.measurements.items()} for e in entries}
    write_text(folder / "metrics.json", json.dumps(metrics, indent=1) + "\n")
    pd.DataFrame([row for entry in entries for row in _rows(entry)]).to_csv(folder / "table.csv", index=False)
    shutil.copytree(best.folder, folder / "best")
    named = {entry.name: entry for entry in entries}
    for name in dict.fromkeys([best.name, *({"crnet", "fcnn"} & named.keys())]):
        last = list(named[name].measurements.values())[-1]
        plots.runs(last.runs).savefig(folder / f"runs_{name}.png")
    for recording in best.measurements:
        one_step = {entry.name: entry.measurements[recording].overall.one_step for entry in entries}
        floor = best.measurements[recording].overall.floor
        plots.error_bars(one_step, floor).savefig(folder / f"errors_{recording}.png")


def _rows(entry: Entry) -> list[dict[str, object]]:
    dead = sum(outcome.dead is not None for outcome in entry.provenance.seeds)
    return [
        {
            "model": entry.name,
            "parameters": entry.parameters,
            "recording": name,
            "one_step": errors_text(measurement.overall.one_step),
            "floor": errors_text(measurement.overall.floor),
            "floor_kind": measurement.overall.floor.kind,
            "position_over_floor": _ratio(measurement.overall.one_step, measurement.overall.floor),
            "model_error": errors_text(measurement.overall.model_error) if measurement.overall.model_error else None,
            "open_loop": _loop_text(measurement),
            "dead_seeds": dead,
            "seeds": len(entry.provenance.seeds),
        }
        for name, measurement in entry.measurements.items()
    ]


def _ratio(errors: Errors, floor: Errors) -> float:
    return round(errors.position_mm.mean / floor.position_mm.mean, 4) if floor.position_mm.mean else math.nan


def _loop_text(measurement: Measurement) -> str:
    loop = measurement.overall.open_loop_mm
    return f"{loop.mean:.0f} ± {loop.sd:.0f} mm" if loop else ""
