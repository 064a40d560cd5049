"""Simulations that are known exactly, and sessions in which what really happens is written down here, not in `gap`."""

from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor, nn

from swarmtwin.dynamics.twist import displacement_of, twist_of
from swarmtwin.gap.catalogue import mechanism_class
from swarmtwin.gap.mechanism import Drive
from swarmtwin.gap.motion import likeliest_displacement
from swarmtwin.gap.noise import Noise
from swarmtwin.gap.session import Session
from swarmtwin.gap.surroundings import Surroundings
from swarmtwin.geometry import compose, displacement_between
from swarmtwin.transitions import Transitions

MM_PER_PWM = 0.35
TRACK_MM = 84.0
SPREAD = (1.0, 1.0, 0.02)
SESSION_S = 1000.0


class ExactBase(nn.Module):
    """Ways that follow from the command alone: of wheels linear in their speeds, of a fin smooth and crooked."""

    parts = ("command",)
    members = 0
    member = None

    def __init__(self, robot):
        super().__init__()
        self.robot = robot

    def description(self):
        return {"kind": "exact"}

    def way(self, command, previous_command, pose):
        if self.robot.kinematics == "differential_drive":
            left, right = (MM_PER_PWM * command).unbind(dim=-1)
            return torch.stack([(left + right) / 2, 0 * left, (right - left) / TRACK_MM], dim=-1)
        if self.robot.kinematics == "unicycle":
            ahead, turn = (self.robot.period_s * command).unbind(dim=-1)
            return torch.stack([ahead, 0 * ahead, turn], dim=-1)
        angle_deg, amplitude_deg, frequency_rad_s = command.unbind(dim=-1)
        thrust = amplitude_deg / 60 * frequency_rad_s / 9
        angle_rad = torch.deg2rad(angle_deg)
        return torch.stack(
            [70 * thrust * angle_rad.cos(), 20 * thrust**2 * angle_rad.sin(), -0.8 * thrust * angle_rad.sin()], dim=-1
        )


def surroundings_of(robot, **changes):
    usual = {"wheel": TRACK_MM, "thrust": None}[robot.actuation.kind]
    content = {"arena_mm": robot.arena_mm, "session_s": SESSION_S, "track_mm": robot.actuation.track_mm or usual}
    return Surroundings(**{**content, **changes})


def drive_of(robot, rng, count=200, **changes):
    """Situations anywhere in the arena, with one neighbour each."""
    arena = robot.arena_mm
    commands = rng.uniform(robot.command_low, robot.command_high, (3, count, len(robot.command)))
    pose = np.column_stack([rng.uniform(arena.low_mm, arena.high_mm, (count, 2)), rng.uniform(-3.1, 3.1, count)])
    content = {
        "command": commands[0],
        "previous_command": commands[1],
        "earlier_command": commands[2],
        "pose": pose,
        "elapsed_s": rng.uniform(0, SESSION_S, count),
        "duration_s": np.full(count, robot.period_s),
        "neighbours": rng.uniform(-200, 200, (count, 1, 3)),
    }
    surroundings = changes.pop("surroundings", None) or surroundings_of(robot)
    filled = {name: torch.as_tensor(changes.get(name, value)).double() for name, value in content.items()}
    return Drive(robot=robot, surroundings=surroundings, **filled)


def moved(robot, name, drive, **values):
    """What the camera measures with one mechanism, and without any."""
    base = ExactBase(robot)
    return likeliest_displacement(base, [mechanism_class(name).at(values)], drive), likeliest_displacement(
        base, [], drive
    )


class Moment(NamedTuple):
    """What R vehicles, one a run, do in one period: commands (R, m), true poses (R, 3), number of the period."""

    base: ExactBase
    command: Tensor
    previous_command: Tensor
    pose: Tensor
    step: int

    @property
    def way(self):
        return self.base.way(self.command, self.previous_command, self.pose)

    @property
    def way_before(self):
        return self.base.way(self.previous_command, self.previous_command, self.pose)


def as_simulated(moment):
    """True displacements (R, 3)."""
    return displacement_of(moment.way)


def as_it_is(pose):
    """Measured poses (R, 3) of true ones."""
    return pose


def steady_spread(way):
    """Standard deviation (R, 3) of the ways."""
    return torch.tensor(SPREAD, dtype=torch.float64).expand_as(way)


def session_of(
    base, rng, moved=as_simulated, seen=as_it_is, spread=steady_spread, camera=None, runs=60, steps=30, vehicle="1"
):
    """Drive R vehicles by random commands: `moved` says where they truly go, `seen` what the camera measures of it.

    Gaussian noise of standard deviation `spread` is added to the ways, and of `camera` to the measured poses.
    """
    robot = base.robot
    rest = np.clip(np.zeros(len(robot.command)), robot.command_low, robot.command_high)
    command = rng.uniform(robot.command_low, robot.command_high, (steps, runs, len(robot.command)))
    previous = np.concatenate([np.tile(rest, (1, runs, 1)), command[:-1]])
    arena = robot.arena_mm
    inner = arena.low_mm + 0.3 * (arena.high_mm - arena.low_mm), arena.low_mm + 0.7 * (arena.high_mm - arena.low_mm)
    start = np.column_stack([rng.uniform(*inner, (runs, 2)), rng.uniform(-3.1, 3.1, runs)])
    pose = torch.as_tensor(start)
    measured = [_photographed(pose, seen, camera, rng)]
    for step in range(steps):
        moment = Moment(base, torch.as_tensor(command[step]), torch.as_tensor(previous[step]), pose, step)
        way = twist_of(moved(moment))
        way = way + spread(way) * torch.as_tensor(rng.normal(size=way.shape))
        pose = compose(pose, displacement_of(way))
        measured.append(_photographed(pose, seen, camera, rng))
    poses = torch.stack(measured).numpy()
    before, earlier = np.full((2, *command.shape), np.nan)
    before[1:], earlier[2:] = command[:-1], command[:-2]
    by_run = np.tile(np.arange(steps), runs), np.repeat(np.arange(runs), steps)
    displacement = displacement_between(poses[:-1], poses[1:])
    taken = [values[by_run] for values in (command, before, earlier, poses[:-1], displacement)]
    transitions = Transitions(
        robot,
        *taken,
        neighbours=np.empty((runs * steps, 0, 3)),
        time_s=(by_run[1] * (steps + 10) + by_run[0]) * robot.period_s,
        duration_s=np.full(runs * steps, robot.period_s),
        run=by_run[1],
        vehicle=np.zeros(runs * steps, dtype=int),
        split=np.zeros(runs * steps, dtype=int),
        runs=tuple(f"run_{run:03d}" for run in range(runs)),
        vehicles=(vehicle,),
    )
    return Session.of(transitions, surroundings_of(robot))


def _photographed(pose, seen, camera, rng):
    if camera is None:
        return seen(pose)
    return seen(pose) + torch.as_tensor(rng.normal(size=pose.shape) * camera)


def known_noise(spread=SPREAD):
    """The noise of `steady_spread`, as it is."""
    log_spread = torch.zeros(8, 3, dtype=torch.float64)
    log_spread[0] = torch.tensor(spread, dtype=torch.float64).log()
    usual = torch.tensor([20.0, 20.0, 0.5], dtype=torch.float64)
    nothing = torch.zeros(3, 5, dtype=torch.float64)
    return Noise(nothing, usual, log_spread, torch.eye(3, dtype=torch.float64), 100.0)
