"""What came of deployments, as a gate judges policies by it."""

import json
from collections import defaultdict
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import yaml

from swarmtwin.errors import UserError
from swarmtwin.plain_yaml import read_yaml
from swarmtwin.robot import Robot
from swarmtwin.tracking.gate import Trials


def deployed_trials(folders: Sequence[Path], robot: Robot) -> dict[str, Trials]:
    """Return how each policy did in deployments, by the digest of its folder.

    A deployment that ended by a safety stop, or was interrupted, did not succeed.

    Args:
        folders: that `deploy` left.
        robot: whose deployments they are.

    Raises:
        UserError: one is named twice, is no deployment of a policy, or one of another robot.
    """
    found: dict[str, list[tuple[bool, bool, float]]] = defaultdict(list)
    if twice := sorted({str(folder) for folder in folders if folders.count(folder) > 1}):
        raise UserError(f"deployment {twice[0]} is named twice: name each once")
    for folder in folders:
        about, metrics = _read(folder)
        if (name := about["robot"]["name"]) != robot.name:
            raise UserError(f"{folder} is a deployment of robot {name!r}, not of {robot.name!r}: leave it out")
        robots = metrics.get("robots")
        as_planned = metrics["control"]["ending"] == "done"
        found[about["policy"]["digest"]].append(
            (
                bool(robots and robots["success"] and as_planned),
                bool(robots and robots["collision"]),
                robots["reward"] if robots else np.nan,
            )
        )
    return {digest: _as_trials(each) for digest, each in found.items()}


def _as_trials(each: Sequence[tuple[bool, bool, float]]) -> Trials:
    succeeded, collided, reward = (np.array(values) for values in zip(*each, strict=True))
    return Trials(succeeded, collided, reward, what="deployments", paired=False)


def _read(folder: Path) -> tuple[dict[str, Any], dict[str, Any]]:
    """Return a deployment's description and its figures."""
    try:
        about = read_yaml(folder / "deployment.yaml")
        metrics = json.loads((folder / "metrics.json").read_text())
        if {"robot", "policy"} <= set(about) and "control" in metrics:
            return about, metrics
    except (OSError, ValueError, TypeError, yaml.YAMLError):
        pass
    raise UserError(f"{folder} is no deployment of a policy: name folders that swarmtwin deploy made")
