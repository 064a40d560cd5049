"""`swarmtwin evaluate`: a simulation model against measured runs."""

import json
from pathlib import Path

from rich import box
from rich.console import Console
from rich.table import Table

from swarmtwin.dynamics.error_plots import scatter_figure
from swarmtwin.dynamics.evaluation import ErrorFigure
from swarmtwin.dynamics.model_folder import read_description
from swarmtwin.files import check_output, folder_digest, new_folder, write_text
from swarmtwin.learning.trainer import Device, torch_device
from swarmtwin.robot import Arena, Robot, StrictModel
from swarmtwin.simulation.evaluation import Measured, Measurement, load_simulation, measure
from swarmtwin.simulation.open_loop_plots import runs_figure
from swarmtwin.tracking import registry
from swarmtwin.tracking.runs import tracked_run
from swarmtwin.transitions.inputs import Vehicles, read_vehicles


class Options(StrictModel):
    """Options of `swarmtwin evaluate`; their defaults stand in conf/evaluate.yaml."""

    robot: Robot
    simulation: str
    recording: Path
    vehicles: Vehicles
    device: Device
    output: Path
    overwrite: bool


def run(options: Options) -> None:
    """Measure the model, save figures and pictures, track the run and show a table.

    Raises:
        UserError: no such model or recording, they do not fit each other, or the output is taken.
    """
    settings = options.model_dump(mode="json")
    simulation = registry.model_folder(options.simulation)
    inputs = [options.recording, simulation]
    check_output(options.output, "evaluate", options.overwrite, inputs)
    device = torch_device(options.device)
    model, provenance = load_simulation(simulation, options.robot)
    kind = read_description(simulation).model["name"]
    recording = read_vehicles(options.recording, options.robot, options.vehicles)
    name = f"{options.robot.name}-{kind} on {options.recording.name}"
    with tracked_run("dynamics", f"evaluate {name}", settings, inputs) as tracked:
        with new_folder(options.output, "evaluate", settings, options.overwrite, inputs=inputs) as folder:
            measurement = measure(model.to(device), provenance, Measured.of(recording, options.recording))
            about = {"robot": options.robot.name, "model": kind, "recording": options.recording.name}
            write_text(folder / "metrics.json", json.dumps({**about, **measurement.metrics()}, indent=1) + "\n")
            _draw(folder, measurement, recording.header.arena_mm)
        tracked.metrics(measurement.overall.tracked())
        tracked.tag("simulation.digest", folder_digest(simulation))
        tracked.folder(options.output, "evaluation")
    Console().print(table(name, measurement))
    Console().print(f"figures and pictures: {options.output}", highlight=False, soft_wrap=True)


def table(name: str, measurement: Measurement) -> Table:
    """Return a table a person reads: the figures of each vehicle, and of all; mean ± standard deviation."""
    title = f"{name}{', held-out runs' if measurement.held_out else ''}"
    floor = "floor" if measurement.overall.floor_kind == "exact" else "floor, estimate"
    shown = Table(box=box.SIMPLE_HEAD, padding=(0, 1, 0, 0), pad_edge=False, title=title)
    shown.add_column("\nvehicle", no_wrap=True)
    for heading in (
        "transi-\ntions",
        "one-step\nmm, °",
        f"{floor}\nmm, °",
        "model error\nmm, °",
        "open loop\nmm",
        "\nruns",
    ):
        shown.add_column(heading, justify="right", no_wrap=True)
    rows = list(measurement.vehicles.items())
    if len(rows) > 1:
        rows.append(("all", measurement.overall))
    for vehicle, figures in rows:
        errors = [_errors_text(figure) for figure in (figures.one_step, figures.floor, figures.model_error)]
        loop = figures.open_loop
        loop_cells = (f"{loop.rmse_mm:.0f} ± {loop.rmse_sd_mm:.0f}", str(loop.runs)) if loop else ("", "")
        shown.add_row(vehicle, str(figures.one_step.transitions), *errors, *loop_cells)
    shown.caption = "mean ± standard deviation, position above orientation"
    if history := measurement.overall.floors.get("history"):
        position, orientation = _errors_text(history.error).splitlines()
        kind = "" if history.kind == "exact" else ", estimate"
        shown.caption += f"\nfloor given the commands before as well{kind}: {position} mm, {orientation}°"
    return shown


def _errors_text(figure: ErrorFigure | None) -> str:
    if figure is None:
        return ""
    position = f"{figure.position_mm:.2f} ± {figure.position_sd_mm:.2f}"
    return f"{position}\n{figure.orientation_deg:.2f} ± {figure.orientation_sd_deg:.2f}"


def _draw(folder: Path, measurement: Measurement, arena: Arena) -> None:
    runs_figure(measurement.runs, arena).savefig(folder / "runs.png")
    scatter_figure(measurement.predicted, measurement.transitions.displacement).savefig(folder / "scatter.png")
