"""What all interfaces to a world share: how it is opened, its spaces, the actions taken, what is told of a step."""

from pathlib import Path
from typing import Any

import numpy as np
from gymnasium.spaces import Box

from swarmtwin.configuration import config_files
from swarmtwin.errors import UserError, near_miss
from swarmtwin.plain_yaml import read_yaml
from swarmtwin.robot import Arena, Robot
from swarmtwin.simulation.displacement_table import TableSettings, tabulated
from swarmtwin.simulation.simulation import Simulation
from swarmtwin.simulation.simulation_folder import load_simulation
from swarmtwin.world.compiled import fastest_motion
from swarmtwin.world.motion import Motion, SimulatedMotion
from swarmtwin.world.task import Task, task_config
from swarmtwin.world.world import Step, World

Moved = Motion | Simulation | Path | str
"""What moves the vehicles: a motion, a simulation, or the folder of one, as train or a diagnosis leaves it."""


def open_world(
    task: Task | str,
    moved: Moved,
    worlds: int = 1,
    seed: int = 0,
    compiled: bool = False,
    table: TableSettings | None = None,
) -> World:
    """Return the worlds of a task.

    Args:
        task: what the vehicles are asked to do, or the name of a file in `conf/task/`.
        moved: what moves them; a motion is of `worlds` and of the task's vehicles.
        worlds: how many there are side by side, W.
        seed: of the scenarios, and of what a simulation draws.
        compiled: take compiled code where there is some, the same to rounding, and what is drawn likewise; it pays for
            many worlds: numba takes a second to load.
        table: of the displacements of a simulation, by which vehicles move instead; None: the simulation moves them.

    Raises:
        UserError: there is no such task or model, or the motion is of another robot, or of other worlds or vehicles; or
            the simulation cannot be tabulated, or not well enough.
    """
    if worlds < 1:
        raise UserError(f"{worlds} worlds: ask for 1 or more")
    if isinstance(moved, Path | str):
        moved = load_simulation(Path(moved))
    if not isinstance(moved, Simulation):
        return World(_built(task, moved.robot), moved, worlds, seed, compiled)
    built = _built(task, moved.robot, moved.conditions.arena_mm)
    simulation = moved if table is None else tabulated(moved, table)
    motion_of = fastest_motion if compiled else SimulatedMotion
    return World(built, motion_of(simulation, worlds, built.vehicles, seed=seed), worlds, seed, compiled)


def _built(task: Task | str, robot: Robot, arena: Arena | None = None) -> Task:
    if isinstance(task, Task):
        return task
    known = config_files("task")
    if task not in known:
        raise UserError(f"no such task: {task!r}: {near_miss(task, known)}")
    return task_config(read_yaml(known[task]), str(known[task])).build(robot, arena)


def observation_space(task: Task) -> Box:
    """Return the space of one vehicle's observations, (o,)."""
    return Box(-np.inf, np.inf, (task.observation_size,), np.float32)


def command_space(robot: Robot) -> Box:
    """Return the space of one vehicle's commands, (m,): within the robot's limits, in its units."""
    return Box(robot.command_low.astype(np.float32), robot.command_high.astype(np.float32), dtype=np.float32)


def commands_of(actions: Any, shape: tuple[int, ...], robot: Robot, whose: str = "actions") -> np.ndarray:
    """Return actions as commands of a shape, whose last axis is the columns of the robot's command.

    Raises:
        UserError: they are no numbers, or of another shape; it names `whose` they are.
    """
    columns = ", ".join(robot.command_columns)
    try:
        commands = np.asarray(actions, dtype=float)
    except (TypeError, ValueError):
        raise UserError(f"{whose}: no array of numbers: give one of shape {shape}, its columns {columns}") from None
    if commands.shape != shape:
        raise UserError(f"{whose}: shape {commands.shape}: give {shape}, the columns of {robot.name!r} being {columns}")
    return commands


def vehicle_info(step: Step, vehicle: int) -> dict[str, Any]:
    """Return what one period brought a vehicle of the first world, and whether its group has `reached` all targets."""
    return {
        "collided": bool(step.events.collided[0, vehicle]),
        "left_arena": bool(step.events.left_arena[0, vehicle]),
        "at_target": bool(step.events.at_target[0, vehicle]),
        "reached": bool(step.reached[0]),
    }
