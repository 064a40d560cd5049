"""`swarmtwin rollout`: a policy from the same starts in the simulation and on stand-ins, side by side."""

import json
from pathlib import Path
from typing import Annotated, Any, Literal

import numpy as np
import pandas as pd
from pydantic import Field
from rich import box
from rich.console import Console
from rich.table import Table

from swarmtwin.files import check_output, new_folder, write_text
from swarmtwin.learning.trainer import Device, torch_device
from swarmtwin.policies.policy_folder import StoredPolicy, load_policy
from swarmtwin.policies.reward_plots import NAMES
from swarmtwin.policies.rollout_comparison import (
    Difference,
    check_count,
    draw_scenarios,
    metrics_of,
    rollout_table,
    tracked_figures,
)
from swarmtwin.robot import Positive, Robot, Seed, StrictModel
from swarmtwin.studies.rollout_runner import in_simulation, on_stand_ins, other_vehicles, simulation_of
from swarmtwin.tracking import registry
from swarmtwin.tracking.runs import tracked_run
from swarmtwin.transitions.inputs import Vehicles
from swarmtwin.world.rendering.paths import paths_figure
from swarmtwin.world.rendering.video import pictures, write_video
from swarmtwin.world.rollout import Rollout, Show, chosen_world, figures_of

MotionName = Literal["simulation", "stand_in"]


class ModelFolder(StrictModel):
    """A model by its folder, `models:/NAME@ALIAS` or `models:/NAME/VERSION`; policy=X is short for policy.folder=X."""

    folder: str


class Options(StrictModel):
    """Options of `swarmtwin rollout`; their defaults stand in conf/rollout.yaml."""

    robot: Robot
    policy: ModelFolder
    simulation: str | None
    on: Annotated[tuple[MotionName, ...], Field(min_length=1)]
    vehicles: Vehicles
    count: Annotated[int, Field(ge=1)]
    seed: Seed
    effects: tuple[Any, ...]
    sampled: bool | None
    device: Device
    show: Show
    video: bool
    speed: Positive
    output: Path
    overwrite: bool


def run(options: Options) -> None:
    """Roll out, save figures, every step, pictures and the film, track the run and show a table.

    Raises:
        UserError: no such policy or simulation, they do not fit each other or the vehicles, too few roll-outs, or the
            output is taken.
    """
    check_count(options.count)
    settings = options.model_dump(mode="json")
    folder_of_policy = registry.model_folder(options.policy.folder)
    check_output(options.output, "rollout", options.overwrite, [folder_of_policy])
    policy = load_policy(folder_of_policy, options.robot)
    inputs = [folder_of_policy]
    name = f"{options.robot.name}-{policy.task.name}"
    with tracked_run("transfer", f"rollout {name}", settings, inputs, options.seed) as tracked:
        with new_folder(options.output, "rollout", settings, options.overwrite, inputs=inputs) as folder:
            rollouts = _rollouts(options, policy)
            metrics = metrics_of(rollouts)
            about = {"robot": options.robot.name, "task": policy.task.name}
            write_text(folder / "metrics.json", json.dumps({**about, **metrics}, indent=1) + "\n")
            tables = [rollout_table(motion, rollout) for motion, rollout in rollouts.items()]
            pd.concat(tables).to_parquet(folder / "rollouts.parquet", index=False)
            _draw(folder, options, rollouts)
        tracked.metrics(tracked_figures(metrics))
        tracked.tag("policy.digest", registry.folder_digest(folder_of_policy))
        tracked.folder(options.output, "rollout")
    Console().print(table(name, rollouts, metrics))
    Console().print(f"figures, pictures and film: {options.output}", highlight=False, soft_wrap=True)


def _rollouts(options: Options, policy: StoredPolicy) -> dict[str, Rollout]:
    task = policy.build_task()
    scenario = draw_scenarios(task, options.count, "rollout", options.seed)
    rollouts: dict[str, Rollout] = {}
    for motion in options.on:
        if motion == "simulation":
            simulation = simulation_of(policy, options.simulation, options.robot)
            simulation.to(torch_device(options.device))
            rollouts[motion] = in_simulation(policy, simulation, scenario, options.sampled, options.seed)
        else:
            vehicles = other_vehicles(options.vehicles, task)
            rollouts[motion] = on_stand_ins(policy, vehicles, scenario, options.seed, options.effects)
    return rollouts


def _draw(folder: Path, options: Options, rollouts: dict[str, Rollout]) -> None:
    shown = chosen_world(list(rollouts.values())[-1], options.show)
    titled = {NAMES[motion]: rollout for motion, rollout in rollouts.items()}
    paths_figure(titled, shown).savefig(folder / "rollouts.png")
    if options.video:
        write_video(folder / "rollout.mp4", pictures(titled, shown, options.speed))


def table(name: str, rollouts: dict[str, Rollout], metrics: dict[str, Any]) -> Table:
    """Return a table a person reads: a column for the simulation and one for the stand-ins."""
    count = len(next(iter(rollouts.values())))
    shown = Table(box=box.SIMPLE_HEAD, title=f"{name}: {count} roll-outs from the same starts")
    shown.add_column("")
    for motion in rollouts:
        shown.add_column(NAMES[motion], justify="right", no_wrap=True)
    figures = [figures_of(rollout) for rollout in rollouts.values()]
    shown.add_row("reward a vehicle and step", *(f"{f.reward:.2f} ± {f.reward_sd:.2f}" for f in figures))
    labels = {"success": "success", "collision": "with a collision", "left_arena": "left the arena"}
    for quantity, label in labels.items():
        rates = [getattr(each, quantity) for each in figures]
        shown.add_row(label, *(f"{rate.value:.0%} ({rate.low:.0%} to {rate.high:.0%})" for rate in rates))
    shown.add_row("time to reach, s", *(_spread(f.reach_time_s, f.reach_time_sd_s) for f in figures))
    shown.add_row(
        "distance in the end, mm", *(f"{f.final_distance_mm:.0f} ± {f.final_distance_sd_mm:.0f}" for f in figures)
    )
    shown.caption = "mean ± standard deviation over roll-outs; rates with 95 % intervals"
    if difference := metrics.get("reward_difference_percent"):
        found = Difference(difference["value"], difference["low"], difference["high"])
        shown.caption += f"\nreward on stand-ins against simulation: {found}"
    return shown


def _spread(mean: float, deviation: float) -> str:
    return "none did" if np.isnan(mean) else f"{mean:.1f} ± {deviation:.1f}"
