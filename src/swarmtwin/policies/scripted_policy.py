"""The scripted policy as one rolls it out: by name, beside learned ones, for any task."""

from pathlib import Path

import numpy as np

from swarmtwin.configuration import config_files
from swarmtwin.errors import UserError, near_miss
from swarmtwin.plain_yaml import read_yaml
from swarmtwin.policies.policy_folder import TaskChanges
from swarmtwin.robot import Robot
from swarmtwin.world.scripted import ScriptedPolicy
from swarmtwin.world.task import Task, task_config

SCRIPTED = "scripted"


class ScriptedTask:
    """The scripted policy of a robot's task.

    Attributes:
        robot: whose vehicles it commands.
        task: what is asked of them.
        arena: where they drive.
        simulation: the folder of the simulation to roll out in where no other is named: the pipeline's.
    """

    def __init__(self, robot: Robot, name: str | None, changes: TaskChanges) -> None:
        """Build the task `name` of `conf/task/`, with changes.

        Raises:
            UserError: no task is named, there is none of that name, or this robot cannot do it.
        """
        known = config_files("task")
        if name is None:
            raise UserError(f"policy={SCRIPTED} is for any task: add task=NAME, one of {', '.join(known)}")
        if name not in known:
            raise UserError(f"no such task: {name!r}: {near_miss(name, known)}")
        self.robot = robot
        self.task = changes.of(task_config(read_yaml(known[name]), str(known[name])))
        self.arena = changes.arena_mm or robot.arena_mm
        self.simulation = Path("artifacts/dynamics") / robot.name / "crnet_synthetic"
        self._scripted = ScriptedPolicy(self.build_task())

    def build_task(self) -> Task:
        """Return the task."""
        return self.task.build(self.robot, self.arena)

    def act(self, observation: np.ndarray) -> np.ndarray:
        """Return commands (W, K, m) for the observations (W, K, o) of W · K vehicles."""
        return self._scripted.act(observation)
