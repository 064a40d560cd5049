"""A policy as a folder: a description to read, weights that nothing executable can hide in, and the same as ONNX."""

from pathlib import Path
from typing import Annotated, Any, Literal

import numpy as np
from pydantic import Field
from torch import Tensor

from swarmtwin.errors import UserError
from swarmtwin.learning.stored_folder import StoredFolder
from swarmtwin.policies.policy import Architecture, Policy
from swarmtwin.policies.rollout_comparison import Evaluation
from swarmtwin.robot import Arena, CommandColumn, Robot, StrictModel
from swarmtwin.world.task import Task, TaskConfig, task_config


class SimulationOrigin(StrictModel):
    """The dynamics model that a policy was learned in.

    Attributes:
        source: how it was named: a folder, or models:/NAME/VERSION.
        model: the kind of model.
        digest: identifies its content.
        recording: name of the recording it was trained on.
        origin: whether its transitions were real, synthetic or mixed.
    """

    source: str
    model: str
    digest: str
    recording: str
    origin: str


class InitialOrigin(StrictModel):
    """The policy that learning went on from.

    Attributes:
        source: how it was named.
        digest: identifies its weights.
    """

    source: str
    digest: str


class SeedOutcome(StrictModel):
    """What came of one seed: its best evaluation, and why it cannot be used, if it cannot."""

    seed: int
    best: Evaluation | None
    failed: str | None


class PolicyProvenance(StrictModel):
    """What `policy.yaml` says of a policy's origin.

    Attributes:
        simulation: the model it was learned in.
        algorithm: how it was learned, all values.
        schedule: how long, and how it was evaluated.
        randomisation: by what roll-outs differed, all values; None: they did not.
        started_from: the policy that learning went on from; None: it began from nothing.
        seed: the seed chosen, best in the final scenarios.
        seeds: what came of each.
    """

    simulation: SimulationOrigin
    algorithm: dict[str, Any]
    schedule: dict[str, Any]
    randomisation: dict[str, Any] | None = None
    started_from: InitialOrigin | None = None
    seed: int
    seeds: tuple[SeedOutcome, ...]

    @property
    def evaluation(self) -> Evaluation:
        """How good the policy was in the final scenarios."""
        best = next(outcome for outcome in self.seeds if outcome.seed == self.seed).best
        assert best is not None
        return best

    def tags(self, task: str) -> dict[str, str]:
        """Return what people should read beside a registered version: the task, and how good it was in simulation."""
        return {
            "task": task,
            "algorithm": str(self.algorithm["name"]),
            "simulation": f"{self.simulation.model} ({self.simulation.origin})",
            "success": f"{self.evaluation.success:.3f}",
            "reward": f"{self.evaluation.reward:.3f}",
        }


class ModelFolder(StrictModel):
    """A model by its folder, `models:/NAME@ALIAS` or `models:/NAME/VERSION`; policy=X is short for policy.folder=X."""

    folder: str


class TaskName(StrictModel):
    """The task that a policy must be for; task=X is short for task.name=X. None: whichever it is for."""

    name: str | None


class TaskChanges(StrictModel):
    """How a task is to differ from the one that a policy was learned for, where the policy can drive it all the same.

    Attributes:
        vehicles: how many there are; None: as many as in the task.
        arena_mm: where they drive; None: where the policy was learned.
        changes: any other fields of the task by name, with their values; None: as in the task.
    """

    vehicles: Annotated[int, Field(ge=1)] | None = None
    arena_mm: Arena | None = None
    changes: dict[str, Any] | None = None

    def of(self, task: TaskConfig) -> TaskConfig:
        """Return a task with the changes.

        Raises:
            UserError: the task has no such field, or it cannot have that value.
        """
        vehicles = {} if self.vehicles is None else {"vehicles": self.vehicles}
        return task_config({**task.model_dump(mode="json"), **(self.changes or {}), **vehicles}, f"task {task.name!r}")


class PlayedTask(TaskName, TaskChanges):
    """The task that a policy must be for, and how it is to differ from the one that the policy was learned for."""


DESCRIPTION = "policy.yaml"


class Description(StrictModel):
    """The content of `policy.yaml`.

    Attributes:
        format: changes when older versions cannot read the folder.
        robot: the robot, in full.
        task: what the policy was learned for, in full.
        observation: what the numbers of an observation are, in order.
        architecture: of its network.
        command: the limits that the network's outputs −1 and 1 stand for.
        arena_mm: where the policy learned to move; None in folders of before: the robot's usual arena.
        provenance: where the policy comes from.
    """

    format: Literal[1] = 1
    robot: Robot
    task: dict[str, Any]
    observation: tuple[str, ...]
    architecture: Architecture
    command: dict[str, CommandColumn]
    arena_mm: Arena | None = None
    provenance: PolicyProvenance


POLICY_FOLDER = StoredFolder(DESCRIPTION, Description, holds="policy", made_by="learn", remedy="learn the policy anew")


class StoredPolicy:
    """A policy that was loaded, with what its folder says of it.

    Attributes:
        folder: where it was loaded from.
        policy: the policy, ready to act.
        robot: whose vehicles it commands.
        task: what it was learned for.
        arena: where it learned to move.
        provenance: where it comes from.
    """

    def __init__(
        self, folder: Path, policy: Policy, task: TaskConfig, arena: Arena, provenance: PolicyProvenance
    ) -> None:
        self.folder = folder
        self.policy = policy
        self.robot = policy.robot
        self.task = task
        self.arena = arena
        self.provenance = provenance

    def build_task(self) -> Task:
        """Return the task that the policy was learned for, or that it is to do instead."""
        return self.task.build(self.robot, self.arena)

    def act(self, observation: np.ndarray) -> np.ndarray:
        """Return commands (W, K, m) for the observations (W, K, o) of W · K vehicles."""
        return self.policy.act(observation)

    def in_changed_task(self, changes: TaskChanges) -> "StoredPolicy":
        """Return the policy with the task changed, such as to another number of vehicles.

        Raises:
            UserError: the robot cannot do that task, or the policy sees other things than its vehicles do.
        """
        task, arena = changes.of(self.task), changes.arena_mm or self.arena
        shown, looked_at = task.build(self.robot, arena).observation_names, self.policy.observation_names
        if task.sees_commands != self.task.sees_commands:
            raise UserError(
                f"{self.folder} looks at the last {self.task.sees_commands} commands, and is to be shown "
                f"{task.sees_commands}: learn a policy with task.sees_commands={task.sees_commands}"
            )
        if shown != looked_at:
            raise UserError(
                f"{self.folder} looks at {len(looked_at)} numbers, and a vehicle of {task.vehicles} observes "
                f"{len(shown)}, of every other one: learn a policy with task.sees_nearest=4 for any number of vehicles"
            )
        return StoredPolicy(self.folder, self.policy, task, arena, self.provenance)


def save_policy(folder: Path, policy: Policy, task: TaskConfig, arena: Arena, provenance: PolicyProvenance) -> None:
    """Write a policy into an existing `folder`, as safetensors and as ONNX.

    Raises:
        UserError: its outputs are not finite, or ONNX computes others.
    """
    from swarmtwin.policies.onnx_export import ONNX, write_onnx  # for those who learn: robots' computers have no ONNX

    description = Description(
        robot=policy.robot,
        task=task.model_dump(mode="json"),
        observation=policy.observation_names,
        architecture=policy.architecture,
        command=policy.robot.command,
        arena_mm=arena,
        provenance=provenance,
    )
    write_onnx(folder / ONNX, policy)
    POLICY_FOLDER.save(folder, description, policy.state_dict())


def load_policy(folder: Path, robot: Robot | None = None, task_name: str | None = None) -> StoredPolicy:
    """Load a policy, of `robot` and for the task `task_name` where they are given; nothing in the folder is executed.

    Raises:
        UserError: a file is missing, damaged, does not belong to the other, or the policy is of another robot or task.
    """
    folder = Path(folder)
    path = folder / DESCRIPTION
    description = POLICY_FOLDER.read(folder)
    if robot is not None:
        _check_robot(folder, description.robot, robot)
    task = task_config(description.task, f"{path}: task")
    if task_name not in (None, task.name):
        raise UserError(f"{folder} is a policy for task {task.name!r}, not for {task_name!r}: name another")
    arena = description.arena_mm or description.robot.arena_mm
    observed = task.build(description.robot, arena).observation_names
    if observed != description.observation:
        raise UserError(
            f"{path}: the policy looks at {len(description.observation)} numbers that are not the {len(observed)} that "
            f"its task {task.name!r} shows: {POLICY_FOLDER.remedy}"
        )

    def build(weights: dict[str, Tensor]) -> Policy:
        return Policy.with_weights(description.robot, description.observation, description.architecture, weights)

    return StoredPolicy(folder, POLICY_FOLDER.load_into(folder, build), task, arena, description.provenance)


def _check_robot(folder: Path, found: Robot, wanted: Robot) -> None:
    if found.name != wanted.name:
        raise UserError(f"{folder} is a policy of robot {found.name!r}: add robot={found.name}")
    if (found.command, found.period_s) != (wanted.command, wanted.period_s):
        raise UserError(
            f"{folder} was learned for other commands or another period than conf/robot states: {POLICY_FOLDER.remedy}"
        )
