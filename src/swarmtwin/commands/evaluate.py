"""`swarmtwin evaluate`: a simulation model against measured runs."""

import json
from pathlib import Path

from rich.console import Console
from rich.table import Table

from swarmtwin import registry
from swarmtwin.commands.measurement import Errors, Figures, Measurement, load_simulation, measure
from swarmtwin.commands.sources import Vehicles, read_vehicles
from swarmtwin.dynamics import figures as plots
from swarmtwin.files import new_folder, write_text
from swarmtwin.robot import Robot, StrictModel
from swarmtwin.tracking import tracked_run


class Options(StrictModel):
    """Options of `swarmtwin evaluate`; their defaults stand in conf/evaluate.yaml."""

    robot: Robot
    simulation: str
    recording: Path
    vehicles: Vehicles
    output: Path
    overwrite: bool


def run(options: Options) -> None:
    """Measure the model, save figures and pictures, track the run and show a table.

    Raises:
        UserError: no such model or recording, they do not fit each other, or the output is taken.
    """
    settings = options.model_dump(mode="json")
    dynamics, provenance = load_simulation(registry.model_folder(options.simulation), options.robot)
    recording = read_vehicles(options.recording, options.robot, options.vehicles)
    name = f"{options.robot.name}-{dynamics.config.name} on {options.recording.name}"
    with tracked_run("dynamics", f"evaluate {name}", settings, [options.recording]) as tracked:
        with new_folder(options.output, "evaluate", settings, options.overwrite) as folder:
            measurement = measure(dynamics, provenance, recording, options.recording)
            about = {"robot": options.robot.name, "model": dynamics.config.name, "recording": options.recording.name}
            write_text(folder / "metrics.json", json.dumps({**about, **measurement.metrics()}, indent=1) + "\n")
            _draw(folder, measurement)
        tracked.metrics(tracked_figures(measurement.overall))
        tracked.folder(options.output, "evaluation")
    Console().print(table(name, measurement))
    Console().print(f"figures and pictures: {options.output}", highlight=False)


def tracked_figures(figures: Figures) -> dict[str, float]:
    """Return the figures by name and unit, as MLflow keeps them."""
    named = {
        "one_step_position_mm": figures.one_step.position_mm.mean,
        "one_step_orientation_deg": figures.one_step.orientation_deg.mean,
        "floor_position_mm": figures.floor.position_mm.mean,
        "floor_orientation_deg": figures.floor.orientation_deg.mean,
    }
    if figures.model_error:
        named["model_error_position_mm"] = figures.model_error.position_mm.mean
        named["model_error_orientation_deg"] = figures.model_error.orientation_deg.mean
    if figures.open_loop_mm:
        named["open_loop_mm"] = figures.open_loop_mm.mean
    return named


def table(name: str, measurement: Measurement) -> Table:
    """Return a table a person reads: the figures of each vehicle, and below them those over all."""
    exact = measurement.overall.floor.kind == "exact"
    title = f"{name}{' (held-out runs)' if measurement.held_out else ''}"
    floor = "floor" if exact else "floor (estimate)"
    shown = Table("vehicle", "transitions", "one-step", floor, "model error", "open loop, RMSE", title=title)
    for vehicle, figures in [*measurement.vehicles.items(), ("all", measurement.overall)]:
        loop = figures.open_loop_mm
        shown.add_row(
            vehicle,
            str(figures.transitions),
            errors_text(figures.one_step),
            errors_text(figures.floor),
            errors_text(figures.model_error) if figures.model_error else "",
            f"{loop.mean:.0f} ± {loop.sd:.0f} mm, {loop.runs} runs" if loop else "",
        )
    for column in shown.columns[1:]:
        column.justify = "right"
    return shown


def errors_text(errors: Errors) -> str:
    """Return errors as the paper's tables write them: mean ± standard deviation."""
    position, orientation = errors.position_mm, errors.orientation_deg
    return f"{position.mean:.2f} ± {position.sd:.2f} mm  {orientation.mean:.2f} ± {orientation.sd:.2f}°"


def _draw(folder: Path, measurement: Measurement) -> None:
    plots.runs(measurement.runs).savefig(folder / "runs.png")
    plots.scatter(measurement.predicted, measurement.transitions.displacement).savefig(folder / "scatter.png")
