"""Rolls a policy out from the same starts, moved by simulations and by groups of stand-ins."""

from collections.abc import Callable, Mapping

import numpy as np

from swarmtwin.errors import UserError
from swarmtwin.robot import Robot
from swarmtwin.standin.effects import parse_effects
from swarmtwin.standin.live import LiveVehicles
from swarmtwin.studies.reality_gap.options import StandIns
from swarmtwin.world.motion import Motion
from swarmtwin.world.rollout import Act, Rollout, play
from swarmtwin.world.scenario import Scenario
from swarmtwin.world.task import Task

MakeMotion = Callable[[], Motion]
"""Gives what moves the vehicles of all roll-outs, with chances of its own from the beginning."""


class RandomCommands:
    """Commands drawn evenly between the robot's limits: the same ones, in the same order, wherever it begins anew."""

    def __init__(self, robot: Robot, seed: int) -> None:
        self.robot = robot
        self._rng = np.random.default_rng(seed)

    def act(self, observation: np.ndarray) -> np.ndarray:
        """Return commands (W, K, m) for the observations (W, K, o) of W · K vehicles."""
        shape = (*observation.shape[:2], len(self.robot.command))
        return self._rng.uniform(self.robot.command_low, self.robot.command_high, shape)


def stand_in_motions(groups: Mapping[str, StandIns], task: Task, worlds: int, seed: int) -> dict[str, MakeMotion]:
    """Return what moves the vehicles of `worlds` roll-outs of a task, by group of stand-ins.

    Raises:
        UserError: a group has too few vehicles, names one twice, or is told an effect that makes no sense.
    """
    motions: dict[str, MakeMotion] = {}
    for name, group in groups.items():
        if len(group.vehicles) < task.vehicles:
            raise UserError(
                f"stand_ins.{name}.vehicles are {len(group.vehicles)}, task {task.config.name!r} is for "
                f"{task.vehicles}: give {task.vehicles} ids or more, the first ones drive"
            )
        motions[name] = _stand_ins(group, task, worlds, seed)
        motions[name]()
    return motions


def _stand_ins(group: StandIns, task: Task, worlds: int, seed: int) -> MakeMotion:
    vehicles = group.vehicles[: task.vehicles]
    effects = parse_effects(group.effects, task.robot, task.vehicles)
    return lambda: LiveVehicles(task.robot, vehicles, worlds, seed, effects, planned_steps=task.steps)


def roll_out_everywhere(
    task: Task, scenario: Scenario, motions: Mapping[str, MakeMotion], policy: Callable[[], Act]
) -> dict[str, Rollout]:
    """Roll a policy out from the same starts, moved by each of some motions.

    Args:
        task: what is asked of the vehicles.
        scenario: where the roll-outs begin.
        motions: what moves the vehicles, by name.
        policy: gives the policy as it begins.

    Raises:
        UserError: the policy gives a command, or a simulation a displacement, that is not finite.
    """
    return {name: play(task, motion(), scenario, policy()) for name, motion in motions.items()}
