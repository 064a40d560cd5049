"""`swarmtwin deploy`: a policy drives real vehicles under an overhead camera; a recording and figures result."""

import json
import logging
from collections.abc import Sequence
from pathlib import Path
from typing import Annotated, Any

from pydantic import BeforeValidator, Field
from rich.console import Console

from swarmtwin.deploy.control.deployment import Deployment
from swarmtwin.deploy.control.driver import PolicyDriver
from swarmtwin.deploy.control.outcome import Outcome, end_by
from swarmtwin.deploy.control.plan import Plan
from swarmtwin.deploy.control.recovery import check_no_kill, recover
from swarmtwin.deploy.control.settings import WatchSettings
from swarmtwin.errors import RefusedError, UserError
from swarmtwin.extras import require_extra
from swarmtwin.files import CHECKPOINTS, check_output, folder_digest, new_folder, output_folder, write_text
from swarmtwin.policies.policy_folder import ModelFolder, StoredPolicy, TaskName, load_policy
from swarmtwin.robot import Positive
from swarmtwin.simulation.simulation import Simulation
from swarmtwin.studies.deployed_policy import (
    check_obstacles,
    deployment_metrics,
    deployment_table,
    draw_deployment,
    imagined,
    scenario_for,
    tracked_deployment_figures,
)
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
from swarmtwin.studies.rollout_runner import simulation_of
from swarmtwin.tracking.model_source import model_folder
from swarmtwin.transitions.inputs import Vehicles
from swarmtwin.world.rollout_storage import save_rollouts
from swarmtwin.world.task import Task

log = logging.getLogger(__name__)


def _several(value: Any) -> Any:
    """Make one target, [x, y], or one obstacle, [x, y, radius], a list of one."""
    single = isinstance(value, Sequence) and len(value) > 0 and not isinstance(value[0], Sequence)
    return [value] if single else value


Targets = Annotated[tuple[tuple[float, float], ...] | None, BeforeValidator(_several)]
Obstacles = Annotated[tuple[tuple[float, float, Positive], ...], BeforeValidator(_several)]


class Options(DrivingOptions):
    """Options of `swarmtwin deploy`; their defaults stand in conf/deploy.yaml."""

    policy: ModelFolder
    task: TaskName
    simulation: str | None
    vehicles: Vehicles
    target: Targets
    obstacles: Obstacles
    steps: Annotated[int, Field(ge=1)] | None
    watch: WatchSettings
    compare: Annotated[int, Field(ge=0)]
    video: bool
    speed: Positive


def run(options: Options) -> dict[str, Any]:
    """Deploy, save the recording, figures and pictures, track the run and show a table; return the figures.

    Raises:
        UserError: something is wrong before anything moves.
        RefusedError: the vehicles were stopped for safety's sake, or could not be seen to stand.
        KeyboardInterrupt: somebody interrupted it; the vehicles stand.
    """
    if options.recover is not None:
        recover(options.recover)
        Console().print(f"recording: {options.recover}", highlight=False, soft_wrap=True)
        return {"output": str(options.recover)}
    folder_of_policy = model_folder(options.policy.folder, options.task.name)
    policy = load_policy(folder_of_policy, options.robot, options.task.name)
    simulation = simulation_of(policy, options.simulation, options.robot)
    task = policy.task.build(options.robot, policy.arena)
    vehicles = chosen_vehicles(options.vehicles, task)
    check_obstacles(task, options.obstacles)
    name = f"{options.robot.name}-{policy.task.name}"
    output = output_folder(options.output, "deploy", name)
    check_no_kill(output, "deploy")
    check_output(output, "deploy", options.overwrite, [folder_of_policy])
    settings = options.model_dump(mode="json")
    periods = min(options.steps or task.steps, task.steps)
    with new_folder(output, "deploy", settings, options.overwrite, True, [folder_of_policy]) as folder:
        plan = Plan(
            robot=options.robot,
            vehicles=vehicles,
            arena=policy.arena,
            simulation=simulation.eval(),
            link=None,
            obstacles=options.obstacles,
            collision_mm=getattr(task.config, "collision_mm", None),
            periods=periods,
            safety=options.safety,
            timing=options.timing,
            watch=options.watch,
        )
        metrics, outcome = _deploy(options, plan, policy, task, simulation, folder)
        _track(options, folder, folder_of_policy, name, metrics)
    Console().print(deployment_table(f"{name}: deployed", metrics))
    Console().print(f"recording, figures and pictures: {output}", highlight=False, soft_wrap=True)
    end_by(outcome, output)
    return {**tracked_deployment_figures(metrics), "output": str(output)}


def chosen_vehicles(chosen: Vehicles, task: Task) -> tuple[str, ...]:
    """Return the ids of the vehicles that do a task.

    Raises:
        UserError: another number is chosen than the task has, or one twice.
    """
    vehicles = chosen or tuple(str(1 + index) for index in range(task.vehicles))
    if len(vehicles) != task.vehicles:
        raise UserError(
            f"vehicles=[{','.join(vehicles)}] are {len(vehicles)}, the policy is for {task.vehicles}: give as many ids"
        )
    if twice := sorted({one for one in vehicles if vehicles.count(one) > 1}):
        raise UserError(f"vehicle {twice[0]!r} is named twice: give each id once")
    return vehicles


def _deploy(
    options: Options, plan: Plan, policy: StoredPolicy, task: Task, simulation: Simulation, folder: Path
) -> tuple[dict[str, Any], Outcome]:
    """Drive, and leave the recording, figures and pictures in `folder`."""
    link, told = open_link(options.robot, options.broker, plan.vehicles, "controller")
    view = None
    try:
        plan = plan.with_supervisor(told)
        eyes = open_eyes(options.robot, plan.vehicles, plan.arena, options.camera, options.calibration, options.by_hand)
        title = f"{options.robot.title}: {policy.task.name}"
        header = header_of(plan, f"deployment of {options.policy.folder}")
        about = about_deployment(plan, header, options.model_dump(mode="json"), eyes)
        about["policy"] = {"source": options.policy.folder, "digest": folder_digest(policy.folder)}
        about["simulation"] = options.simulation or policy.provenance.simulation.source
        if options.page.show:
            view = open_view(title, options.robot, plan.vehicles, plan.arena, eyes, options.page)
        say_what_cannot_be_stopped(options.robot)
        with Deployment(plan, link, eyes.camera, eyes.tracker, folder / CHECKPOINTS, about, view) as deployment:
            start = deployment.wait_for_vehicles()
            scenario = scenario_for(task, start, options.target, options.obstacles, options.seed)
            driver = PolicyDriver(policy.policy, task, scenario.targets[0], scenario.obstacles[0])
            outcome = deployment.drive(driver, plan.periods, "run_001")
        counters = counted(deployment, [outcome])
    finally:
        if view:
            view.close()
        link.close()
    about["outcome"] = counters
    finish_recording(folder, plan, header, about)
    real = driver.rollout
    simulated = None
    if real is not None and options.compare:
        simulated = imagined(policy, task, simulation, driver.scenario, options.compare, options.seed)
    metrics = deployment_metrics(real, simulated, counters)
    write_text(folder / "metrics.json", json.dumps(metrics, indent=1) + "\n")
    if real is not None:
        save_rollouts(folder / "rollouts.npz", {"robots": real} | ({"simulation": simulated} if simulated else {}))
        draw_deployment(folder, real, simulated, options.video, options.speed)
    return metrics, outcome


def _track(options: Options, folder: Path, policy: Path, name: str, metrics: dict[str, Any]) -> None:
    """Keep the run; the recording must not be lost where MLflow is not installed, or its store cannot be used."""
    settings = options.model_dump(mode="json")
    try:
        require_extra("tracking", "MLflow")
        from swarmtwin.studies.tracked_inputs import model_input
        from swarmtwin.tracking.runs import tracked_run

        given = model_input(policy, "policy")
        with tracked_run("deployment", f"deploy {name}", settings, [given], options.seed) as tracked:
            tracked.metrics(tracked_deployment_figures(metrics))
            tracked.tag("policy.digest", given.digest)
            tracked.tag("ending", metrics["control"]["ending"])
            tracked.tag("reason", metrics["control"]["reason"])
            tracked.folder(folder, "deployment")
    except RefusedError:
        raise
    except UserError as error:
        log.warning("not tracked: %s", error)
