"""Families of stand-ins: bodies of physics that share no formula, so that a diagnosis cannot know them by heart."""

import importlib
from collections.abc import Callable, Sequence
from importlib.util import find_spec
from typing import Any, Literal, get_args

from swarmtwin.configuration import config_folder
from swarmtwin.errors import UserError, near_miss
from swarmtwin.robot import Robot
from swarmtwin.standin.effect import Effect
from swarmtwin.standin.effects import parse_effects
from swarmtwin.standin.live import LiveStandIns, LiveVehicles
from swarmtwin.standin.session import DrivenSession, StandInSession, drive_session

Family = Literal["formulas", "unruly", "rigid_body"]
FAMILIES: tuple[Family, ...] = get_args(Family)

NO_FORCE = ("drift_velocity_mm_s", "aimed_speed", "roll")
"""Places of an effect at which a rigid-body engine cannot have it: what acts there is no force of its own."""


def session_options(family: Family) -> dict[str, Any]:
    """Return what a stand-in session of a family is told beside what every session is told.

    `formulas` are the stand-ins as they are; `unruly` the same, as wild as the paper's robots and driven as its authors
    drove them; `rigid_body` are moved by a rigid-body engine.
    """
    return {"character": "unruly", "command_mode": "published"} if family == "unruly" else {}


def driver_of(family: Family) -> Callable[[StandInSession], DrivenSession]:
    """Return what moves the vehicles of a family.

    Raises:
        UserError: the engine of `rigid_body` is not there.
    """
    if family != "rigid_body":
        return drive_session
    driver: Callable[[StandInSession], DrivenSession] = _rigid_body().drive_rigid_session
    return driver


def live_vehicles_of(family: Family) -> type[LiveStandIns]:
    """Return what drives vehicles of a family live.

    Raises:
        UserError: the engine of `rigid_body` is not there.
    """
    if family != "rigid_body":
        return LiveVehicles
    live: type[LiveStandIns] = _rigid_body("live").LiveRigidVehicles
    return live


def chosen_families(asked: Sequence[str] | None) -> tuple[Family, ...]:
    """Return the families that are asked for, in their order; None: all whose engine is installed.

    Raises:
        UserError: there is no such family, or its engine is missing.
    """
    if asked is None:
        return tuple(family for family in FAMILIES if is_available(family))
    for name in asked:
        if name not in FAMILIES:
            raise UserError(f"families: no such family: {name!r}: {near_miss(name, FAMILIES)}")
    chosen = tuple(family for family in FAMILIES if family in asked)
    for family in chosen:
        driver_of(family)
    return chosen


def _rigid_body(module: str = "driving") -> Any:
    name = "swarmtwin.standin.rigid_body"
    if find_spec(name) is None:
        raise UserError("family 'rigid_body': this version's stand-ins have no rigid-body engine: leave the family out")
    if find_spec("mujoco") is None:
        raise UserError("family 'rigid_body' needs MuJoCo: pip install 'mujoco>=4.0.0,<5', or leave the family out")
    return importlib.import_module(f"{name}.{module}")


def is_available(family: Family) -> bool:
    """Return whether sessions of a family can be driven here."""
    try:
        driver_of(family)
    except UserError:
        return False
    return True


def has_robot(family: Family, robot: str) -> bool:
    """Return whether a family has a body for a robot."""
    return family != "rigid_body" or _is_driven(robot, ())


def has_effect(family: Family, robot: str, name: str, kind: type[Effect]) -> bool:
    """Return whether the physics of a family can have an effect, given by its name in the catalogue and its class.

    The engine's camera is not told the time, so what it sees cannot change with it.
    """
    if family != "rigid_body":
        return True
    if kind.__module__.startswith("swarmtwin.standin.effects"):
        return _is_driven(robot, (name,))
    changed = [hook for hook in (*NO_FORCE, "picture") if getattr(kind, hook) is not getattr(Effect, hook)]
    return not changed or (changed == ["picture"] and not kind.ages)


def _is_driven(robot_name: str, effects: tuple[str, ...]) -> bool:
    robot = Robot.load(config_folder() / "robot" / f"{robot_name}.yaml")
    vehicles = ("1", "2")
    try:
        made = parse_effects([{"name": name} for name in effects], robot, len(vehicles))
        _rigid_body().machine_of(StandInSession(robot, vehicles, 1, 1, 1, made))
    except UserError:
        return False
    return True
