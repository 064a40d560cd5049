"""Dynamics models that are known exactly, and situations to ask simulations for."""

import numpy as np
import torch

from swarmtwin.dynamics.predictor import DynamicsModule
from swarmtwin.geometry import exp_map
from swarmtwin.learning.situation import Situation
from swarmtwin.simulation.conditions import SessionConditions
from swarmtwin.simulation.mechanism import mechanism_class
from swarmtwin.simulation.simulation import Simulation

MM_PER_PWM = 0.35
TRACK_MM = 84.0
SESSION_S = 1000.0


class ExactDynamics(DynamicsModule):
    """Twists that follow from the command alone: of wheels linear in their speeds, of a fin smooth and crooked."""

    inputs = ("command",)

    def __init__(self, robot, motion_noise=None):
        super().__init__()
        self.robot = robot
        self.motion_noise = motion_noise

    def twist(self, command):
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

    def predict(self, situation):
        return exp_map(self.twist(situation.command.double()))


class LaggingDynamics(ExactDynamics):
    """The same with a share of the old twist left in each period: it looks at the previous command."""

    inputs = ("command", "previous_command")
    left_over = 0.2

    def predict(self, situation):
        new, old = (self.twist(one.double()) for one in (situation.command, situation.previous_command))
        return exp_map(new + self.left_over * (old - new))


def conditions_of(robot, **changes):
    usual = TRACK_MM if robot.actuation.kind == "wheel" else None
    content = {"arena_mm": robot.arena_mm, "session_s": SESSION_S, "track_mm": robot.actuation.track_mm or usual}
    return SessionConditions(**{**content, **changes})


def situation_of(robot, rng, count=200, **changes):
    """Situations anywhere in the arena, with one neighbour each, float64."""
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
    return Situation(**{name: torch.as_tensor(changes.get(name, value)).double() for name, value in content.items()})


def mechanisms(**values):
    return [mechanism_class(name).at(own) for name, own in values.items()]


def simulation_with(robot, dynamics=None, conditions=None, motion_noise=None, **values):
    """The exact model extended by mechanisms, named with their parameters."""
    base = dynamics or ExactDynamics(robot, motion_noise)
    return Simulation(base, mechanisms(**values), conditions or conditions_of(robot))


def moved(robot, name, situation, **values):
    """What the camera measures with one mechanism, and without any, (N, 3)."""
    extended = simulation_with(robot, **{name: values})
    return extended.predict(situation), ExactDynamics(robot).predict(situation)
