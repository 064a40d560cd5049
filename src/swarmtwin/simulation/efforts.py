"""Efforts and wheels: what actuators are given in commands, and how much further twists lead by it.

N vehicles at a time; tensors are float64.
"""

from collections.abc import Callable

import torch
from torch import Tensor

from swarmtwin.robot import Robot
from swarmtwin.simulation.mechanism import Moment


def wheel_travel(twist: Tensor, track_mm: float) -> Tensor:
    """Return how far the left and the right wheel roll, (N, 2) mm, on twists (N, 3) over a period."""
    apart = twist[:, 2:] * (track_mm / 2)
    return torch.cat([twist[:, :1] - apart, twist[:, :1] + apart], dim=-1)


def twist_of_wheels(travel: Tensor, twist: Tensor, track_mm: float) -> Tensor:
    """Return the twists (N, 3) of wheels that roll (N, 2) mm; what `twist` (N, 3) had to the side is kept."""
    left, right = travel[:, 0], travel[:, 1]
    return torch.stack([(left + right) / 2, twist[:, 1], (right - left) / track_mm], dim=-1)


def change_effort(command: Tensor, moment: Moment, change: Callable[[Tensor], Tensor]) -> Tensor:
    """Apply `change` to the efforts in commands (N, m): the actuators' columns, or the speeds of both wheels."""
    robot = moment.robot
    if robot.actuation.effort:
        columns = [robot.command_columns.index(name) for name in robot.actuation.effort]
        changed = command.clone()
        changed[:, columns] = change(command[:, columns])
        return changed
    half = moment.track_mm / 2
    wheels = torch.stack([command[:, 0] - half * command[:, 1], command[:, 0] + half * command[:, 1]], dim=-1)
    left, right = change(wheels).unbind(dim=-1)
    return torch.stack([(left + right) / 2, (right - left) / (2 * half)], dim=-1)


def effort_limit(robot: Robot) -> float:
    """Return the largest effort of an actuator in the command's unit; of wheels commanded as a unicycle, in mm/s."""
    if robot.actuation.effort:
        return robot.command[robot.actuation.effort[0]].high
    return float(robot.command_high[0] + robot.command_high[1] * (robot.actuation.track_mm or 0.0) / 2)


def effort_unit(robot: Robot) -> str:
    """Return the unit of efforts."""
    return robot.command[robot.actuation.effort[0]].unit if robot.actuation.effort else "mm/s"


def slowed(twist: Tensor, factor: Tensor, track_mm: float) -> Tensor:
    """Return the twists (N, 3) of vehicles that come `factor` as far, (N or 1, 1).

    Or (…, 2) by left and right wheel, or (…, 3) by how far ahead, aside and around.
    """
    if factor.shape[-1] == 2:
        return twist_of_wheels(wheel_travel(twist, track_mm) * factor, twist, track_mm)
    return twist * factor


def by_effort(factor: Tensor, moment: Moment) -> Tensor:
    """Return by which factors (…, 3) motion ahead, aside and around changes if all efforts change by one (…, 1)."""
    exponents = torch.tensor(moment.conditions.effort_exponents, dtype=factor.dtype)
    if bool((exponents == 1).all()):
        return factor
    return torch.exp(factor.clamp(min=1e-6).log() * exponents)  # a tenth of the time that a power takes
