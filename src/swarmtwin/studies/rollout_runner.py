"""Policies rolled out from given scenarios: in a simulation, and on stand-ins that are driven live."""

import logging
from collections.abc import Mapping, Sequence
from typing import Any, Literal

from swarmtwin.diagnosis.measured_ranges import chosen_randomisation
from swarmtwin.errors import UserError
from swarmtwin.files import folder_digest
from swarmtwin.learning.device import Device, torch_device
from swarmtwin.policies.policy_folder import StoredPolicy
from swarmtwin.policies.rollout_comparison import draw_scenarios
from swarmtwin.policies.scripted_policy import ScriptedTask
from swarmtwin.robot import Robot
from swarmtwin.simulation.evaluation import load_simulation
from swarmtwin.simulation.randomisation import Randomisation
from swarmtwin.simulation.simulation import Simulation
from swarmtwin.standin.effects import parse_effects
from swarmtwin.standin.live import LiveVehicles
from swarmtwin.standin.session import require_stand_in
from swarmtwin.tracking.model_source import model_folder
from swarmtwin.world.motion import Motion, SimulatedMotion
from swarmtwin.world.randomised_motion import RandomisedMotion
from swarmtwin.world.rollout import Rollout, play
from swarmtwin.world.scenario import Scenario
from swarmtwin.world.task import Task

log = logging.getLogger(__name__)

MotionName = Literal["simulation", "stand_in"]
"""What moves the vehicles of a roll-out."""


def roll_out_policy(
    policy: StoredPolicy | ScriptedTask,
    motions: Sequence[MotionName],
    *,
    count: int,
    seed: int,
    simulation: str | None,
    sampled: bool | None,
    device: Device,
    vehicles: Sequence[str] | None,
    effects: Sequence[Any],
    randomisation: Mapping[str, Any] | str | None = None,
    draws: int = 16,
) -> dict[str, Rollout]:
    """Roll a policy out from the same starts, by each of some motions.

    Args:
        policy: the policy.
        motions: what moves the vehicles.
        count: of roll-outs.
        seed: of the starts and of what is drawn.
        simulation: a folder or a registered model; None: that which the policy was learned in, or the pipeline's.
        sampled: whether the simulation is sampled; None: as `SimulatedMotion` chooses.
        device: where the simulation computes.
        vehicles: ids of the stand-ins; None: as `other_vehicles` chooses.
        effects: that the stand-ins are told to play.
        randomisation: what differs from roll-out to roll-out in the simulation: see `chosen_randomisation`.
        draws: how many of these differ, at most.

    Raises:
        UserError: something differs in the simulation, and it is none of the motions; see also `simulation_of`,
            `chosen_randomisation`, `other_vehicles`, `in_simulation` and `on_stand_ins`.
    """
    if randomisation is not None and "simulation" not in motions:
        raise UserError("randomisation=... is of the simulation: add on=[simulation], or leave it out")
    task = policy.build_task()
    scenario = draw_scenarios(task, count, "rollout", seed)
    rollouts: dict[str, Rollout] = {}
    for motion in motions:
        if motion == "simulation":
            moved_by = simulation_of(policy, simulation, policy.robot).to(torch_device(device))
            differing = chosen_randomisation(randomisation, moved_by, draws)
            rollouts[motion] = in_simulation(policy, moved_by, scenario, sampled, seed, differing)
        else:
            rollouts[motion] = on_stand_ins(policy, other_vehicles(vehicles, task), scenario, seed, effects)
    return rollouts


def other_vehicles(chosen: Sequence[str] | None, task: Task) -> tuple[str, ...]:
    """Return the stand-ins that play a task: those chosen, or the first ones after vehicle 1, which was recorded.

    Raises:
        UserError: another number of vehicles was chosen than the task has, or the robot has no stand-in.
    """
    require_stand_in(task.robot)
    if chosen is None:
        return tuple(str(2 + index) for index in range(task.vehicles))
    if len(chosen) != task.vehicles:
        raise UserError(
            f"vehicles=[{','.join(chosen)}] are {len(chosen)}, task {task.config.name!r} is for {task.vehicles}: "
            f"give {task.vehicles} ids, or none"
        )
    return tuple(chosen)


def simulation_of(policy: StoredPolicy | ScriptedTask, chosen: str | None, robot: Robot) -> Simulation:
    """Return the simulation chosen, or the one that a policy was learned in; of a scripted one, the pipeline's.

    Raises:
        UserError: there is none, or it is of another robot.
    """
    if isinstance(policy, ScriptedTask):
        return load_simulation(model_folder(chosen or str(policy.simulation)), robot)[0]
    learned_in = policy.provenance.simulation
    reference = chosen or learned_in.source
    try:
        folder = model_folder(reference)
    except UserError as error:
        if chosen:
            raise
        raise UserError(f"the simulation that {policy.folder} was learned in: {error}; or add simulation=...") from None
    simulation, _ = load_simulation(folder, robot)
    if chosen is None and folder_digest(folder) != learned_in.digest:
        log.warning("%s is no longer the model that %s was learned in", reference, policy.folder)
    return simulation


def in_simulation(
    policy: StoredPolicy | ScriptedTask,
    simulation: Simulation,
    scenario: Scenario,
    sampled: bool | None = None,
    seed: int = 0,
    randomisation: Randomisation | None = None,
) -> Rollout:
    """Roll a policy out in a simulation, sampled with a seed or most likely; None: as its motion chooses.

    With a randomisation roll-outs differ by what is drawn of it.

    Raises:
        UserError: the policy gives a command, or the model a displacement, that is not finite.
    """
    task = policy.build_task()
    motion: Motion
    if randomisation is None:
        motion = SimulatedMotion(simulation, len(scenario), task.vehicles, sampled, seed)
    else:
        motion = RandomisedMotion(simulation, randomisation, len(scenario), task.vehicles, sampled, seed)
    return play(task, motion, scenario, policy.act)


def on_stand_ins(
    policy: StoredPolicy | ScriptedTask,
    vehicles: Sequence[str],
    scenario: Scenario,
    seed: int,
    effects: Sequence[Any] = (),
) -> Rollout:
    """Roll a policy out on stand-ins.

    Raises:
        UserError: an effect makes no sense for this robot, or the policy gives a command that is not finite.
    """
    task = policy.build_task()
    told = parse_effects(effects, policy.robot, len(vehicles))
    live = LiveVehicles(policy.robot, vehicles, len(scenario), seed, told, planned_steps=task.steps)
    return play(task, live, scenario, policy.act)
