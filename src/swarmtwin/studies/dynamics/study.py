"""`swarmtwin experiment name=dynamics`: tables 1 and 2 of the paper, trained on real data, with what they lack.

Each model is measured on runs it has never seen, beside the noise floor, a plain MLP and the kinematic model.
"""

import json
import shutil
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

import pandas as pd
from rich.console import Console

from swarmtwin.dynamics.provenance import Provenance
from swarmtwin.errors import UserError
from swarmtwin.files import new_folder, write_text
from swarmtwin.recordings.reading import read_recording
from swarmtwin.recordings.recording import Recording
from swarmtwin.robot import Arena, Robot, StrictModel
from swarmtwin.simulation.evaluation import Measured, Measurement, load_simulation, measure
from swarmtwin.simulation.open_loop_storage import save_open_loop
from swarmtwin.studies.dynamics.comparison_plots import draw_comparison
from swarmtwin.studies.dynamics.table import figure_columns, model_table
from swarmtwin.studies.tracked_inputs import model_input, recording_input
from swarmtwin.tracking.runs import tracked_run


class Options(StrictModel):
    """Options; their defaults stand in conf/experiment/dynamics.yaml."""

    name: Literal["dynamics"]
    robot: Robot
    models: Path
    train_vehicle: Path
    other_vehicle: Path
    open_loop: Path
    pictures: bool
    output: Path
    overwrite: bool

    @property
    def recordings(self) -> dict[str, Path]:
        """The recordings to measure on, by what they are for."""
        return {name: getattr(self, name) for name in ("train_vehicle", "other_vehicle", "open_loop")}


@dataclass(frozen=True)
class Entry:
    """One trained model and how it measures on each recording."""

    name: str
    folder: Path
    parameters: int
    provenance: Provenance
    measurements: dict[str, Measurement]


def run(options: Options) -> dict[str, Any]:
    """Measure all models, save table, pictures and the best of them, and show the table; return the best one's errors.

    Raises:
        UserError: there is no model, a recording is missing, or the output is taken.
    """
    settings = options.model_dump(mode="json")
    inputs = [options.models, *options.recordings.values()]
    models = _model_folders(options.models)
    recordings = {name: read_recording(folder, options.robot) for name, folder in options.recordings.items()}
    given = [
        *(recording_input(options.recordings[name], "test", recording) for name, recording in recordings.items()),
        *(model_input(folder, "model") for folder in models),
    ]
    with (
        new_folder(options.output, "experiment", settings, options.overwrite, inputs=inputs) as folder,
        tracked_run("dynamics", f"{options.robot.name} models compared", settings, given) as tracked,
    ):
        entries = _entries(options, models, recordings)
        best = best_entry(entries)
        _save(folder, entries, best, options.robot.arena_mm)
        if options.pictures:
            draw_comparison(folder, folder)
        for entry in entries:
            for recording, measurement in entry.measurements.items():
                figures = measurement.overall.tracked()
                tracked.metrics({f"{entry.name}/{recording}/{key}": value for key, value in figures.items()})
        tracked.tag("best_model", best.name)
        tracked.folder(folder, "comparison")
    Console().print(model_table(options.robot.title, pd.read_csv(options.output / "table.csv")).drawn())
    one_step = best.measurements["train_vehicle"].overall.one_step
    figures = {"position_mm": one_step.position_mm, "orientation_deg": one_step.orientation_deg}
    return {"best_model": best.name, **figures, "output": str(options.output)}


def best_entry(entries: Sequence[Entry]) -> Entry:
    """Return the model with the smallest errors on the validation runs, position and orientation weighed alike.

    Only models trained on real transitions compete: errors on synthetic validation rows are not comparable with theirs.

    Raises:
        UserError: there is none.
    """
    competing = [entry for entry in entries if entry.provenance.origin == "real"]
    if not competing:
        raise UserError("no model was trained on real transitions alone, so none can be chosen: train one of them so")
    lowest = {
        name: min(entry.provenance.chosen.errors[name] for entry in competing)
        for name in ("position_mm", "orientation_deg")
    }
    return min(competing, key=lambda entry: sum(entry.provenance.chosen.errors[name] / lowest[name] for name in lowest))


def _model_folders(parent: Path) -> list[Path]:
    return sorted(folder for folder in parent.iterdir() if (folder / "model.yaml").exists())


def _entries(options: Options, folders: Sequence[Path], recordings: Mapping[str, Recording]) -> list[Entry]:
    """Measure every model folder on every recording; the worst comes first, as in the paper's tables."""
    measured = {name: Measured.of(recording, options.recordings[name]) for name, recording in recordings.items()}
    entries = []
    for folder in folders:
        simulation, provenance = load_simulation(folder, options.robot)
        measurements = {place: measure(simulation, provenance, each) for place, each in measured.items()}
        parameters = sum(weights.numel() for weights in simulation.parameters())
        name = folder.name
        if provenance.origin == "synthetic":  # the paper's -S
            name = f"{name.removesuffix('_synthetic')}-S"
        entries.append(Entry(name, folder, parameters, provenance, measurements))
    return sorted(entries, key=lambda entry: -entry.measurements["train_vehicle"].overall.one_step.position_mm)


def _save(folder: Path, entries: Sequence[Entry], best: Entry, arena: Arena) -> None:
    metrics = {e.name: {name: m.metrics() for name, m in e.measurements.items()} for e in entries}
    write_text(folder / "metrics.json", json.dumps(metrics, indent=1) + "\n")
    (folder / "summary").mkdir()
    for entry in entries:
        write_text(folder / "summary" / f"{entry.name}.json", json.dumps(_summary(entry), indent=1) + "\n")
    rows = [
        {
            "model": entry.name,
            "parameters": entry.parameters,
            "recording": recording,
            **figure_columns(measurement.overall),
            "dead_seeds": sum(outcome.dead is not None for outcome in entry.provenance.seeds),
            "seeds": len(entry.provenance.seeds),
            "best": entry is best,
        }
        for entry in entries
        for recording, measurement in entry.measurements.items()
    ]
    pd.DataFrame(rows).to_csv(folder / "table.csv", index=False)
    shutil.copytree(best.folder, folder / "best")
    (folder / "open_loop").mkdir()
    for entry in entries:
        save_open_loop(folder / "open_loop" / f"{entry.name}.parquet", entry.measurements["open_loop"].runs, arena)


def _summary(entry: Entry) -> dict[str, float]:
    """Return the figures that experiments are compared by, as `dvc metrics show` prints them."""
    here, elsewhere = (entry.measurements[name].overall for name in ("train_vehicle", "other_vehicle"))
    loop = entry.measurements["open_loop"].overall.open_loop
    figures = {
        "position_mm": here.one_step.position_mm,
        "orientation_deg": here.one_step.orientation_deg,
        "floor_mm": here.floor.position_mm,
        "other_vehicle_mm": elsewhere.one_step.position_mm,
    }
    return figures | ({"open_loop_mm": loop.rmse_mm} if loop else {})
