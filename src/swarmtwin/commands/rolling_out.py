"""Policies rolled out from given scenes: in a simulation, and on stand-ins that are driven live."""

import logging
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from swarmtwin import registry
from swarmtwin.commands.measurement import load_simulation
from swarmtwin.dynamics.base import Dynamics
from swarmtwin.errors import UserError
from swarmtwin.policies.store import StoredPolicy
from swarmtwin.robot import Robot
from swarmtwin.standin.effects import parse_effects
from swarmtwin.standin.live import LiveVehicles
from swarmtwin.standin.session import require_stand_in
from swarmtwin.world.motion import Motion, SimulatedMotion
from swarmtwin.world.rollout import Rollout, roll_out
from swarmtwin.world.scene import Scene
from swarmtwin.world.task import Task
from swarmtwin.world.world import World

log = logging.getLogger(__name__)

FIRST_VEHICLE = 2


def other_vehicles(chosen: Sequence[str] | None, task: Task) -> tuple[str, ...]:
    """Return the stand-ins that play a task: those chosen, or the first ones after vehicle 1, which was recorded.

    Raises:
        UserError: another number of vehicles was chosen than the task has, or the robot has no stand-in.
    """
    require_stand_in(task.robot)
    if chosen is None:
        return tuple(str(FIRST_VEHICLE + index) for index in range(task.vehicles))
    if len(chosen) != task.vehicles:
        raise UserError(
            f"vehicles=[{','.join(chosen)}] are {len(chosen)}, task {task.config.name!r} is for {task.vehicles}: "
            f"give {task.vehicles} ids, or none"
        )
    return tuple(chosen)


def simulation_of(policy: StoredPolicy, chosen: str | None, robot: Robot) -> tuple[Dynamics, Path]:
    """Return the simulation chosen, or the one that a policy was learned in, and its folder.

    Raises:
        UserError: there is none, or it is of another robot.
    """
    learned_in = policy.provenance.simulation
    reference = chosen or learned_in.source
    try:
        folder = registry.model_folder(reference)
    except UserError as error:
        if chosen:
            raise
        raise UserError(f"the simulation that {policy.folder} was learned in: {error}; or add simulation=...") from None
    dynamics, _ = load_simulation(folder, robot)
    if chosen is None and registry.folder_digest(folder) != learned_in.digest:
        log.warning("%s is no longer the model that %s was learned in", reference, policy.folder)
    return dynamics, folder


def in_simulation(policy: StoredPolicy, dynamics: Dynamics, scene: Scene) -> Rollout:
    """Roll a policy out in a simulation.

    Raises:
        UserError: the policy gives a command, or the model a displacement, that is not finite.
    """
    task = policy.build_task()
    return _played(policy, task, SimulatedMotion(dynamics, len(scene), task.vehicles), scene)


def on_stand_ins(
    policy: StoredPolicy, vehicles: Sequence[str], scene: Scene, seed: int, effects: Sequence[Any] = ()
) -> Rollout:
    """Roll a policy out on stand-ins.

    Raises:
        UserError: an effect makes no sense for this robot, or the policy gives a command that is not finite.
    """
    task = policy.build_task()
    told = parse_effects(effects, policy.robot, len(vehicles))
    live = LiveVehicles(policy.robot, vehicles, len(scene), seed, told, planned_steps=task.steps)
    return _played(policy, task, live, scene)


def _played(policy: StoredPolicy, task: Task, motion: Motion, scene: Scene) -> Rollout:
    world = World(task, motion, len(scene), seed=0)
    world.start(scene)
    return roll_out(world, policy.policy.act)
