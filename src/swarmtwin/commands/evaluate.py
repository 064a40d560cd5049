"""`swarmtwin evaluate`: a simulation model against measured runs."""

from pathlib import Path
from typing import Any

from rich.console import Console

from swarmtwin.dynamics.model_folder import read_description
from swarmtwin.files import check_output, new_folder
from swarmtwin.learning.device import Device, torch_device
from swarmtwin.robot import Robot, StrictModel
from swarmtwin.simulation.evaluation import Measured, load_simulation, measure
from swarmtwin.simulation.evaluation_folder import save_measurement
from swarmtwin.simulation.evaluation_plots import draw_evaluation
from swarmtwin.simulation.evaluation_table import measurement_table
from swarmtwin.studies.tracked_inputs import model_input, recording_input
from swarmtwin.tracking.model_source import model_folder
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


def run(options: Options) -> dict[str, Any]:
    """Measure the model, save figures and pictures, track the run and show a table; return its errors.

    Raises:
        UserError: no such model or recording, they do not fit each other, or the output is taken.
    """
    settings = options.model_dump(mode="json")
    simulation = model_folder(options.simulation)
    inputs = [options.recording, simulation]
    check_output(options.output, "evaluate", options.overwrite, inputs)
    device = torch_device(options.device)
    model, provenance = load_simulation(simulation, options.robot)
    kind = read_description(simulation).model["name"]
    recording = read_vehicles(options.recording, options.robot, options.vehicles)
    name = f"{options.robot.name}-{kind} on {options.recording.name}"
    used = model_input(simulation, "simulation")
    given = [recording_input(options.recording, "measured", recording), used]
    with (
        new_folder(options.output, "evaluate", settings, options.overwrite, inputs=inputs) as folder,
        tracked_run("dynamics", f"evaluate {name}", settings, given) as tracked,
    ):
        measurement = measure(model.to(device), provenance, Measured.of(recording, options.recording))
        about = {"robot": options.robot.name, "model": kind, "recording": options.recording.name}
        save_measurement(folder, measurement, recording.header.arena_mm, about)
        draw_evaluation(folder, folder)
        figures = measurement.overall.tracked()
        tracked.metrics(figures)
        tracked.warnings(recording.warnings)
        tracked.tag("simulation.digest", used.digest)
        tracked.folder(folder, "evaluation")
    Console().print(measurement_table(name, measurement))
    Console().print(f"figures and pictures: {options.output}", highlight=False, soft_wrap=True)
    shown = ("one_step_position_mm", "one_step_orientation_deg", "floor_position_mm", "open_loop_mm")
    return {**{name: figures[name] for name in shown if name in figures}, "output": str(options.output)}
