"""`swarmtwin rollout`: a policy from the same starts in the simulation and on stand-ins, side by side."""

from pathlib import Path
from typing import Annotated, Any

from pydantic import Field
from rich.console import Console

from swarmtwin.files import check_output, new_folder
from swarmtwin.learning.device import Device
from swarmtwin.policies.policy_folder import ModelFolder, PlayedTask, StoredPolicy, load_policy
from swarmtwin.policies.rollout_comparison import check_count, metrics_of, tracked_figures
from swarmtwin.policies.rollout_folder import save_rollout
from swarmtwin.policies.rollout_plots import draw_rollout
from swarmtwin.policies.rollout_table import comparison_table
from swarmtwin.policies.scripted_policy import SCRIPTED, ScriptedTask
from swarmtwin.robot import Positive, Robot, Seed, StrictModel
from swarmtwin.studies.rollout_runner import MotionName, roll_out_policy
from swarmtwin.studies.tracked_inputs import model_input
from swarmtwin.tracking.datasets import Dataset
from swarmtwin.tracking.model_source import model_folder
from swarmtwin.tracking.runs import tracked_run
from swarmtwin.transitions.inputs import Vehicles
from swarmtwin.world.rollout import Show


class Options(StrictModel):
    """Options of `swarmtwin rollout`; their defaults stand in conf/rollout.yaml."""

    robot: Robot
    policy: ModelFolder
    task: PlayedTask
    simulation: str | None
    on: Annotated[tuple[MotionName, ...], Field(min_length=1)]
    vehicles: Vehicles
    count: Annotated[int, Field(ge=1)]
    seed: Seed
    effects: tuple[Any, ...]
    sampled: bool | None
    randomisation: dict[str, Any] | str | None
    draws: Annotated[int, Field(ge=1)]
    device: Device
    show: Show
    video: bool
    viewer: bool
    speed: Positive
    output: Path
    overwrite: bool


def run(options: Options) -> dict[str, Any]:
    """Roll out, save figures, every step, pictures, film and viewer, track the run and show a table; return them.

    Raises:
        UserError: no such policy, task or simulation, they do not fit each other or the vehicles, too few roll-outs,
            or the output is taken.
    """
    check_count(options.count)
    settings = options.model_dump(mode="json")
    policy = _policy(options)
    learned = [policy.folder] if isinstance(policy, StoredPolicy) else []
    check_output(options.output, "rollout", options.overwrite, learned)
    name = f"{options.robot.name}-{policy.task.name}"
    given = [model_input(folder, "policy") for folder in learned]
    if isinstance(options.randomisation, str):
        given.append(Dataset.of_files(Path(options.randomisation), "diagnosis"))
    folders = [one.folder for one in given]
    with (
        new_folder(options.output, "rollout", settings, options.overwrite, inputs=folders) as folder,
        tracked_run("transfer", f"rollout {name}", settings, given, options.seed) as tracked,
    ):
        rollouts = roll_out_policy(
            policy,
            options.on,
            count=options.count,
            seed=options.seed,
            simulation=options.simulation,
            sampled=options.sampled,
            device=options.device,
            vehicles=options.vehicles,
            effects=options.effects,
            randomisation=options.randomisation,
            draws=options.draws,
        )
        metrics = metrics_of(rollouts)
        about = {"robot": options.robot.name, "task": policy.task.name}
        save_rollout(folder, rollouts, metrics, about)
        draw_rollout(folder, folder)
        figures = tracked_figures(metrics)
        tracked.metrics(figures)
        tracked.tag("policy.digest", given[0].digest if learned else SCRIPTED)
        tracked.folder(folder, "rollout")
    Console().print(comparison_table(name, rollouts, metrics))
    Console().print(f"figures, pictures, film and viewer: {options.output}", highlight=False, soft_wrap=True)
    return {**figures, "output": str(options.output)}


def _policy(options: Options) -> StoredPolicy | ScriptedTask:
    """Return the policy to roll out, for the task asked for."""
    if options.policy.folder == SCRIPTED:
        return ScriptedTask(options.robot, options.task.name, options.task)
    folder = model_folder(options.policy.folder, options.task.name)
    return load_policy(folder, options.robot, options.task.name).in_changed_task(options.task)
