"""`swarmtwin collect`: real vehicles drive random, gentle or planned commands inside the fence; a recording results."""

import logging
from pathlib import Path
from typing import Annotated, Any

import numpy as np
from pydantic import BeforeValidator, Field
from rich.console import Console
from rich.table import Table

from swarmtwin.deploy.control.collecting import CollectingDriver, CollectMode
from swarmtwin.deploy.control.deployment import Deployment
from swarmtwin.deploy.control.nominal_motion import nominal_simulation
from swarmtwin.deploy.control.outcome import Outcome, end_by
from swarmtwin.deploy.control.plan import Plan
from swarmtwin.deploy.control.recovery import check_no_kill, recover
from swarmtwin.errors import UserError
from swarmtwin.files import CHECKPOINTS, check_output, new_folder, output_folder
from swarmtwin.simulation.evaluation import load_simulation
from swarmtwin.simulation.simulation import Simulation
from swarmtwin.studies.deployment_runner import (
    DrivingOptions,
    about_deployment,
    counted,
    finish_recording,
    header_of,
    open_eyes,
    open_link,
    open_view,
    say_what_cannot_be_stopped,
)
from swarmtwin.studies.stand_in_recording import read_drive
from swarmtwin.tracking.model_source import model_folder
from swarmtwin.transitions.inputs import as_texts

log = logging.getLogger(__name__)

PLANNED_BY_DIAGNOSIS = "next_drive.csv"


class Options(DrivingOptions):
    """Options of `swarmtwin collect`; their defaults stand in conf/collect.yaml."""

    vehicles: Annotated[tuple[str, ...], BeforeValidator(as_texts), Field(min_length=1)]
    runs: Annotated[int, Field(ge=1)]
    steps: Annotated[int, Field(ge=1)]
    commands: CollectMode
    drive: Path | None
    simulation: str | None


def run(options: Options) -> dict[str, Any]:
    """Drive run after run, save the recording, and show what it holds.

    Raises:
        UserError: something is wrong before anything moves.
        RefusedError: the vehicles were stopped for safety's sake, or could not be seen to stand.
        KeyboardInterrupt: somebody interrupted it; the vehicles stand.
    """
    if options.recover is not None:
        recover(options.recover)
        Console().print(f"recording: {options.recover}", highlight=False, soft_wrap=True)
        return {"output": str(options.recover)}
    if twice := sorted({one for one in options.vehicles if options.vehicles.count(one) > 1}):
        raise UserError(f"vehicle {twice[0]!r} is named twice: give each id once")
    simulation = _simulation(options)
    drive = None if options.drive is None else read_drive(_drive_file(options.drive), options.robot)
    output = output_folder(options.output, "collect", options.robot.name)
    check_no_kill(output, "collect")
    check_output(output, "collect", options.overwrite)
    settings = options.model_dump(mode="json")
    with new_folder(output, "collect", settings, options.overwrite, resumable=True) as folder:
        outcome, counters = _collect(options, simulation, drive, folder)
    Console().print(_table(output, counters))
    end_by(outcome, output)
    return {"runs": counters["runs"], "rows": counters["periods"] * len(options.vehicles), "output": str(output)}


def _simulation(options: Options) -> Simulation:
    if options.simulation is None:
        nominal = nominal_simulation(options.robot)
        log.warning(
            "nothing is known of how %r moves but its kinematics: commands are looked ahead in those, at the largest "
            "speeds that its file calls believable",
            options.robot.name,
        )
        return nominal
    return load_simulation(model_folder(options.simulation), options.robot)[0].eval()


def _drive_file(drive: Path) -> Path:
    """Return the CSV file that a drive is: its own, or that in the folder of a diagnosis."""
    if not drive.is_dir():
        return drive
    if not (drive / PLANNED_BY_DIAGNOSIS).exists():
        raise UserError(f"{drive} plans no next recording: its diagnosis has no causes that it could not tell apart")
    return drive / PLANNED_BY_DIAGNOSIS


def _collect(
    options: Options, simulation: Simulation, drive: np.ndarray | None, folder: Path
) -> tuple[Outcome, dict[str, Any]]:
    robot = options.robot
    link, told = open_link(robot, options.broker, options.vehicles, "collector")
    plan = Plan(
        robot=robot,
        vehicles=options.vehicles,
        arena=robot.arena_mm,
        simulation=simulation,
        link=told,
        collision_mm=None,
        periods=options.runs * options.steps,
        watches=False,
        safety=options.safety,
        timing=options.timing,
    )
    view = None
    outcomes: list[Outcome] = []
    rng = np.random.default_rng(options.seed)
    try:
        eyes = open_eyes(robot, plan.vehicles, plan.arena, options.camera, options.calibration, options.by_hand)
        header = header_of(
            plan, f"collected by swarmtwin, commands {'planned' if drive is not None else options.commands}"
        )
        about = about_deployment(plan, header, options.model_dump(mode="json"), eyes)
        if options.page.show:
            view = open_view(f"{robot.title}: collecting", robot, plan.vehicles, plan.arena, eyes, options.page)
        say_what_cannot_be_stopped(robot)
        with Deployment(plan, link, eyes.camera, eyes.tracker, folder / CHECKPOINTS, about, view) as deployment:
            for index in range(options.runs):
                deployment.wait_for_vehicles()
                part = None if drive is None else np.roll(drive, -index * options.steps, axis=0)
                driver = CollectingDriver(
                    robot, plan.arena, simulation, len(plan.vehicles), options.commands, rng, part
                )
                outcomes.append(deployment.drive(driver, options.steps, f"run_{index + 1:03}"))
                log.info("run %d of %d: %s", index + 1, options.runs, outcomes[-1].reason)
                if outcomes[-1].ending != "done" or not outcomes[-1].is_standing:
                    break
        counters = {"runs": len(outcomes), **counted(deployment, outcomes)}
    finally:
        if view:
            view.close()
        link.close()
    about["outcome"] = counters
    finish_recording(folder, plan, header, about)
    return outcomes[-1], counters


def _table(output: Path, counters: dict[str, Any]) -> Table:
    table = Table("", "", title=f"{output}: collected", show_header=False)
    table.add_row("runs", str(counters["runs"]))
    table.add_row("periods", str(counters["periods"]))
    table.add_row("commands weakened; deadlocks", f"{counters['interventions']}; {counters['deadlocks']}")
    for name, label in (("lateness_ms", "lateness of a period"), ("camera_to_command_ms", "camera to command")):
        times = counters[name]
        table.add_row(f"{label}, ms: median; p99", f"{times['median']:.1f}; {times['p99']:.1f}")
    table.add_row("ended", counters["reason"])
    return table
