"""`swarmtwin experiment name=transfer`: tables 5 and 6 of the paper in small, for every policy of a robot."""

import json
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any, Literal

import numpy as np
import pandas as pd
from pydantic import Field
from rich.console import Console

from swarmtwin.errors import UserError
from swarmtwin.files import check_output, new_folder, write_text
from swarmtwin.policies.policy_folder import DESCRIPTION, StoredPolicy, load_policy
from swarmtwin.policies.rollout_comparison import (
    check_count,
    draw_scenarios,
    metrics_of,
    rollout_table,
    tracked_figures,
)
from swarmtwin.robot import Positive, Robot, Seed, StrictModel
from swarmtwin.studies.rollout_runner import in_simulation, on_stand_ins, other_vehicles, simulation_of
from swarmtwin.studies.tracked_inputs import model_input
from swarmtwin.studies.transfer.table import policy_table
from swarmtwin.studies.transfer.transfer_plots import draw_transfer
from swarmtwin.tracking.runs import tracked_run
from swarmtwin.world.rollout import Rollout, figures_of
from swarmtwin.world.rollout_storage import save_rollouts


class Options(StrictModel):
    """Options; their defaults stand in conf/experiment/transfer.yaml."""

    name: Literal["transfer"]
    robot: Robot
    policies: Path
    count: Annotated[int, Field(ge=1)]
    seed: Seed
    video: bool
    speed: Positive
    pictures: bool
    output: Path
    overwrite: bool


@dataclass(frozen=True)
class Entry:
    """One policy, by its folder's name, and its roll-outs by what moved the vehicles."""

    name: str
    policy: StoredPolicy
    vehicles: tuple[str, ...]
    rollouts: dict[str, Rollout]
    metrics: dict[str, Any]


def run(options: Options) -> dict[str, Any]:
    """Roll out every policy, save table, figures, pictures and films, show the table; return mean successes.

    Raises:
        UserError: there is no policy of the robot, its simulation is missing, or the output is taken.
    """
    check_count(options.count)
    settings, inputs = options.model_dump(mode="json"), [options.policies]
    check_output(options.output, "experiment", options.overwrite, inputs)
    policies = policies_of(options.policies, options.robot)
    given = [model_input(policy.folder, "policy") for policy in policies]
    with (
        new_folder(options.output, "experiment", settings, options.overwrite, inputs=inputs) as folder,
        tracked_run("transfer", f"{options.robot.name} policies", settings, given, options.seed) as tracked,
    ):
        entries = [_entry(options, policy) for policy in policies]
        _save(folder, entries)
        if options.pictures:
            draw_transfer(folder, folder)
        for entry in entries:
            tracked.metrics(tracked_figures(entry.metrics, f"{entry.name}/"))
        tracked.folder(folder, "transfer")
    Console().print(policy_table(options.robot.title, pd.read_csv(options.output / "table.csv")).drawn())
    Console().print(f"pictures and films: {options.output}", highlight=False, soft_wrap=True)
    success = {
        f"{motion}_success": float(np.mean([entry.metrics[motion]["success"]["value"] for entry in entries]))
        for motion in ("simulation", "stand_in")
    }
    return {**success, "output": str(options.output)}


def policies_of(folder: Path, robot: Robot) -> list[StoredPolicy]:
    """Load the policies of a robot, each in a folder of its own; those of other robots are left out.

    Raises:
        UserError: there is none, or one is damaged.
    """
    found = sorted(path for path in folder.iterdir() if (path / DESCRIPTION).exists())
    policies = [policy for policy in map(load_policy, found) if policy.robot.name == robot.name]
    if not policies:
        raise UserError(f"{folder} holds no policy of robot {robot.name!r}: run `dvc repro` first, or swarmtwin learn")
    return policies


def _entry(options: Options, policy: StoredPolicy) -> Entry:
    task = policy.build_task()
    scenario = draw_scenarios(task, options.count, "rollout", options.seed)
    vehicles = other_vehicles(None, task)
    rollouts = {
        "simulation": in_simulation(policy, simulation_of(policy, None, options.robot), scenario),
        "stand_in": on_stand_ins(policy, vehicles, scenario, options.seed),
    }
    return Entry(policy.folder.name, policy, vehicles, rollouts, metrics_of(rollouts))


def _save(folder: Path, entries: Sequence[Entry]) -> None:
    write_text(folder / "metrics.json", json.dumps({e.name: e.metrics for e in entries}, indent=1) + "\n")
    (folder / "summary").mkdir()
    for entry in entries:
        write_text(folder / "summary" / f"{entry.name}.json", json.dumps(_summary(entry), indent=1) + "\n")
    pd.DataFrame([_row(entry) for entry in entries]).to_csv(folder / "table.csv", index=False)
    steps = [
        rollout_table(motion, rollout).assign(policy=entry.name)
        for entry in entries
        for motion, rollout in entry.rollouts.items()
    ]
    pd.concat(steps).to_parquet(folder / "rollouts.parquet", index=False)
    (folder / "rollouts").mkdir()
    for entry in entries:
        save_rollouts(folder / "rollouts" / f"{entry.name}.npz", entry.rollouts)


def _row(entry: Entry) -> dict[str, Any]:
    """Return a policy's line of table.csv, units in the columns' names; reward a vehicle and step."""
    simulation = entry.policy.provenance.simulation
    about = {
        "policy": entry.name,
        "task": entry.policy.task.name,
        "algorithm": entry.policy.provenance.algorithm["name"],
        "simulation": f"{simulation.model} ({simulation.origin})",
        "vehicles": " ".join(entry.vehicles),
        "rollouts": len(entry.rollouts["simulation"]),
    }
    for motion, rollout in entry.rollouts.items():
        figures = figures_of(rollout)
        about |= {f"{motion}_reward": round(figures.reward, 4), f"{motion}_reward_sd": round(figures.reward_sd, 4)}
        for name in ("success", "collision"):
            rate = getattr(figures, name)
            about |= {
                f"{motion}_{name}{end}": round(value, 4) for end, value in zip(("", "_low", "_high"), rate, strict=True)
            }
        about[f"{motion}_reach_time_s"] = round(figures.reach_time_s, 2)
    difference = entry.metrics["reward_difference_percent"]
    return {**about, **{f"reward_difference_percent_{name}": round(value, 2) for name, value in difference.items()}}


def _summary(entry: Entry) -> dict[str, float]:
    """Return the figures that experiments are compared by, as `dvc metrics show` prints them: shares and rewards."""
    vehicles = entry.metrics["stand_in"]
    return {
        "success": vehicles["success"]["value"],
        "simulated_success": entry.metrics["simulation"]["success"]["value"],
        "collision": vehicles["collision"]["value"],
        "reward": vehicles["reward"]["mean"],
    }
