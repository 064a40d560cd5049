"""A policy as a folder: a description to read, weights that nothing executable can hide in, and the same as ONNX."""

from pathlib import Path
from typing import Any, Literal

import yaml

from swarmtwin.errors import UserError
from swarmtwin.files import write_text
from swarmtwin.policies.onnx_file import ONNX, write_onnx
from swarmtwin.policies.policy import Architecture, Policy
from swarmtwin.policies.provenance import PolicyProvenance
from swarmtwin.robot import CommandColumn, Robot, StrictModel
from swarmtwin.weights import load_weights, not_belonging, read_description, save_weights
from swarmtwin.world.registry import task_config
from swarmtwin.world.task import Task, TaskConfig

DESCRIPTION = "policy.yaml"
REMEDY = "learn the policy anew"


class Description(StrictModel):
    """The content of `policy.yaml`.

    Attributes:
        format: changes when older versions cannot read the folder.
        robot: the robot, in full.
        task: what the policy was learned for, in full.
        observation: what the numbers of an observation are, in order.
        architecture: of its network.
        command: the limits that the network's outputs −1 and 1 stand for.
        provenance: where the policy comes from.
    """

    format: Literal[1] = 1
    robot: Robot
    task: dict[str, Any]
    observation: tuple[str, ...]
    architecture: Architecture
    command: dict[str, CommandColumn]
    provenance: PolicyProvenance


class StoredPolicy:
    """A policy that was loaded, with what its folder says of it.

    Attributes:
        folder: where it was loaded from.
        policy: the policy, ready to act.
        robot: whose vehicles it commands.
        task: what it was learned for.
        provenance: where it comes from.
    """

    def __init__(self, folder: Path, policy: Policy, task: TaskConfig, provenance: PolicyProvenance) -> None:
        self.folder = folder
        self.policy = policy
        self.robot = policy.robot
        self.task = task
        self.provenance = provenance

    def build_task(self) -> Task:
        """Return the task that the policy was learned for."""
        return self.task.build(self.robot)


def save_policy(folder: Path, policy: Policy, task: TaskConfig, provenance: PolicyProvenance) -> None:
    """Write a policy into an existing `folder`, as safetensors and as ONNX.

    Raises:
        UserError: its outputs are not finite, or ONNX computes others.
    """
    description = Description(
        robot=policy.robot,
        task=task.model_dump(mode="json"),
        observation=policy.observation_names,
        architecture=policy.architecture,
        command=policy.robot.command,
        provenance=provenance,
    )
    write_onnx(folder / ONNX, policy)
    save_weights(folder, policy.state_dict())
    write_text(folder / DESCRIPTION, yaml.safe_dump(description.model_dump(mode="json"), sort_keys=False))


def load_policy(folder: Path, robot: Robot | None = None) -> StoredPolicy:
    """Load a policy, of `robot` where one is given; nothing in the folder is executed.

    Raises:
        UserError: a file is missing, damaged, does not belong to the other, or the policy is of another robot.
    """
    folder = Path(folder)
    path = folder / DESCRIPTION
    description = Description.parse(read_description(path, "policy", "learn", REMEDY), str(path))
    if robot is not None:
        _check_robot(folder, description.robot, robot)
    task = task_config(description.task, f"{path}: task")
    seen = task.build(description.robot).observation_names
    if seen != description.observation:
        raise UserError(
            f"{path}: the policy looks at {len(description.observation)} numbers that are not the {len(seen)} that its "
            f"task {task.name!r} shows: {REMEDY}"
        )
    weights = load_weights(folder, REMEDY)
    try:
        policy = Policy.with_weights(description.robot, description.observation, description.architecture, weights)
    except RuntimeError:  # names or shapes differ
        raise not_belonging(folder, DESCRIPTION, REMEDY) from None
    return StoredPolicy(folder, policy, task, description.provenance)


def _check_robot(folder: Path, found: Robot, wanted: Robot) -> None:
    if found.name != wanted.name:
        raise UserError(f"{folder} is a policy of robot {found.name!r}: add robot={found.name}")
    if (found.command, found.period_s) != (wanted.command, wanted.period_s):
        raise UserError(f"{folder} was learned for other commands or another period than conf/robot states: {REMEDY}")
