"""`swarmtwin evaluate`: a simulation model against measured runs."""

import json
from pathlib import Path

from rich.console import Console
from rich.table import Table

from swarmtwin import registry
from swarmtwin.commands.measurement import Measured, Measurement, load_simulation, measure
from swarmtwin.commands.sources import Vehicles, read_vehicles
from swarmtwin.dynamics.evaluation import ErrorFigure
from swarmtwin.dynamics.figures import runs_figure, scatter_figure
from swarmtwin.dynamics.open_loop import OpenLoopFigure
from swarmtwin.files import new_folder, write_text
from swarmtwin.robot import Arena, Robot, StrictModel
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
            measurement = measure(dynamics, provenance, Measured.of(recording, options.recording))
            about = {"robot": options.robot.name, "model": dynamics.config.name, "recording": options.recording.name}
            write_text(folder / "metrics.json", json.dumps({**about, **measurement.metrics()}, indent=1) + "\n")
            _draw(folder, measurement, recording.header.arena_mm)
        tracked.metrics(measurement.overall.tracked())
        tracked.folder(options.output, "evaluation")
    Console().print(table(name, measurement))
    Console().print(f"figures and pictures: {options.output}", highlight=False)


def table(name: str, measurement: Measurement) -> Table:
    """Return a table a person reads: the figures of each vehicle, and below them those over all."""
    exact = measurement.overall.floor_kind == "exact"
    title = f"{name}{' (held-out runs)' if measurement.held_out else ''}"
    floor = "floor" if exact else "floor (estimate)"
    shown = Table("vehicle", "transitions", "one-step", floor, "model error", "open loop, RMSE", title=title)
    rows = list(measurement.vehicles.items())
    if len(rows) > 1:
        rows.append(("all", measurement.overall))
    for vehicle, figures in rows:
        errors = (figures.one_step, figures.floor, figures.model_error)
        cells = [in_two_lines(errors_text(figure)) if figure else "" for figure in errors]
        shown.add_row(vehicle, str(figures.one_step.transitions), *cells, in_two_lines(loop_text(figures.open_loop)))
    for column in shown.columns[1:]:
        column.justify = "right"
    return shown


def errors_text(errors: ErrorFigure) -> str:
    """Return errors as the paper's tables write them: mean ± standard deviation."""
    position = f"{errors.position_mm:.2f} ± {errors.position_sd_mm:.2f} mm"
    return f"{position}, {errors.orientation_deg:.2f} ± {errors.orientation_sd_deg:.2f}°"


def loop_text(loop: OpenLoopFigure | None) -> str:
    """Return an open-loop error, mean ± standard deviation over runs; nothing where no run could be predicted."""
    return f"{loop.rmse_mm:.0f} ± {loop.rmse_sd_mm:.0f} mm, {loop.runs} runs" if loop else ""


def in_two_lines(text: str) -> str:
    """Break errors after the first figure, for narrow columns."""
    return text.replace(", ", "\n", 1)


def _draw(folder: Path, measurement: Measurement, arena: Arena) -> None:
    runs_figure(measurement.runs, arena).savefig(folder / "runs.png")
    scatter_figure(measurement.predicted, measurement.transitions.displacement).savefig(folder / "scatter.png")
