"""Roll-outs as one file, from which everything about them can be drawn again."""

import json
import zipfile
from collections.abc import Mapping
from dataclasses import fields
from pathlib import Path
from typing import Any

import numpy as np

from swarmtwin.errors import UserError
from swarmtwin.robot import Arena, Robot
from swarmtwin.world.rollout import Rollout
from swarmtwin.world.scenario import Scenario
from swarmtwin.world.task import task_config

ARRAYS = ("pose", "leg", "command", "reward", "counted", "collided", "left_arena", "at_target", "reached")
SCENARIO_ARRAYS = tuple(field.name for field in fields(Scenario))


def save_rollouts(file: Path, rollouts: Mapping[str, Rollout]) -> None:
    """Write roll-outs, by what moved the vehicles, to a file `.npz`."""
    about: dict[str, Any] = {}
    arrays: dict[str, Any] = {}
    for motion, rollout in rollouts.items():
        parts = {"robot": rollout.robot, "arena": rollout.arena, "task": rollout.task}
        about[motion] = {name: part.model_dump(mode="json") for name, part in parts.items()}
        arrays |= {f"{motion}.{name}": getattr(rollout, name) for name in ARRAYS}
        arrays |= {f"{motion}.scenario.{name}": getattr(rollout.scenario, name) for name in SCENARIO_ARRAYS}
    np.savez_compressed(file, about=np.array(json.dumps(about)), **arrays)


def load_rollouts(file: Path) -> dict[str, Rollout]:
    """Read roll-outs, by what moved the vehicles.

    Raises:
        UserError: the file is missing or damaged.
    """
    try:
        with np.load(file, allow_pickle=False) as content:
            about = json.loads(str(content["about"]))
            return {
                motion: Rollout(
                    robot=Robot.parse(parts["robot"], f"{file}: robot"),
                    arena=Arena.parse(parts["arena"], f"{file}: arena"),
                    task=task_config(parts["task"], f"{file}: task"),
                    scenario=Scenario(**{name: content[f"{motion}.scenario.{name}"] for name in SCENARIO_ARRAYS}),
                    **{name: content[f"{motion}.{name}"] for name in ARRAYS},
                )
                for motion, parts in about.items()
            }
    except (OSError, ValueError, KeyError, zipfile.BadZipFile) as error:
        raise UserError(f"{file}: no roll-outs can be read ({error}): roll out again") from None
