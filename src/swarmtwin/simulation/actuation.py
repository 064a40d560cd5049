"""What a dynamics model shows of its robot's actuators: distance of the wheels, own lag, friction, growth with speed.

Nothing here comes from the robot's file or from a stand-in: the model is asked for commands and its answers are read.
"""

import math
from typing import NamedTuple

import numpy as np
import torch
from scipy import optimize
from torch import Tensor

from swarmtwin.dynamics.predictor import DynamicsModel
from swarmtwin.geometry import log_map
from swarmtwin.learning.situation import Situation
from swarmtwin.robot import Robot
from swarmtwin.simulation.conditions import SessionConditions
from swarmtwin.simulation.efforts import wheel_travel
from swarmtwin.simulation.relaxation import left_over, stopped_by_friction


class TrialCommands(NamedTuple):
    """Random commands (N, m) to ask a model for, each after another one, at poses (N, 3) in the middle of an arena."""

    command: Tensor
    previous_command: Tensor
    pose: Tensor

    @classmethod
    def draw(cls, robot: Robot, conditions: SessionConditions, seed: int, count: int = 2000) -> "TrialCommands":
        """Draw commands over the robot's limits."""
        rng = np.random.default_rng(seed)
        drawn = rng.uniform(robot.command_low, robot.command_high, (2, count, len(robot.command)))
        middle = conditions.centre_mm.numpy()
        pose = np.concatenate([np.tile(middle, (count, 1)), rng.uniform(-np.pi, np.pi, (count, 1))], axis=1)
        return cls(*(torch.as_tensor(values) for values in (*drawn, pose)))


def with_actuation(conditions: SessionConditions, dynamics: DynamicsModel, seed: int) -> SessionConditions:
    """Return session conditions with what a dynamics model shows of its actuators."""
    trial = TrialCommands.draw(dynamics.robot, conditions, seed)
    track_mm = _track_mm(dynamics, trial)
    own_lags, friction_mm_s = _following(dynamics, trial, track_mm)
    learned = {
        "track_mm": track_mm,
        "own_lags": own_lags,
        "gear_friction_mm_s": friction_mm_s,
        "effort_exponents": _effort_exponents(dynamics, trial),
    }
    return conditions.model_copy(update=learned)


def _twist(dynamics: DynamicsModel, command: Tensor, previous: Tensor, pose: Tensor, most_periods: int = 50) -> Tensor:
    """Return the twists (N, 3) under commands, with momentum once the velocity has settled or most periods are over."""
    parts = {"command": command, "previous_command": previous, "earlier_command": previous, "pose": pose}
    parts["velocity"] = torch.zeros(len(command), 3, dtype=command.dtype)
    for _ in range(most_periods):
        twist = log_map(dynamics.predict(Situation(**{part: parts[part] for part in dynamics.inputs})).double())
        velocity = twist / dynamics.robot.period_s
        change = (velocity - parts["velocity"]).abs().mean(dim=0)
        if "velocity" not in dynamics.inputs or bool((change <= 1e-3 * velocity.abs().mean(dim=0)).all()):
            break
        parts["velocity"] = velocity
    return twist


def _track_mm(dynamics: DynamicsModel, trial: TrialCommands) -> float | None:
    """Return the distance between the wheels: how much a wheel turns the vehicle, by how far it brings it.

    None where the robot has no left and right wheel, or the model knows nothing of them.
    """
    robot = dynamics.robot
    if robot.actuation.track_mm:
        return robot.actuation.track_mm
    if robot.actuation.kind != "wheel" or len(robot.actuation.effort) != 2:
        return None
    ahead, turned = [], []
    for name, sign in zip(robot.actuation.effort, (-1.0, 1.0), strict=True):
        column = robot.command_columns.index(name)
        high, low = trial.command.clone(), trial.command.clone()
        high[:, column], low[:, column] = robot.command_high[column], robot.command_low[column]
        change = _twist(dynamics, high, high, trial.pose) - _twist(dynamics, low, low, trial.pose)
        ahead.append(change[:, 0])
        turned.append(sign * change[:, 2])
    track_mm = float(2 * torch.cat(ahead).mean() / torch.cat(turned).mean())
    return track_mm if track_mm > 0 else None


def _following(
    dynamics: DynamicsModel, trial: TrialCommands, track_mm: float | None, longest: float = 1.0
) -> tuple[tuple[float, float, float], float]:
    """Return time constants in periods with which motion follows by itself, and the friction in wheels' gears, mm/s.

    Of thrust each axis has its own: a hull may turn at once and gather way slowly. Wheels have one, of way and turn
    alike: aside they bring a vehicle next to nowhere, and how that follows is the error of the model. Where the model
    looks at velocity, that tells it of the old twist, and there is no lag beside it, nor friction.
    """
    if "previous_command" not in dynamics.inputs or "velocity" in dynamics.inputs:
        return (0.0, 0.0, 0.0), 0.0
    now = _twist(dynamics, trial.command, trial.previous_command, trial.pose)
    steady = _twist(dynamics, trial.command, trial.command, trial.pose)
    before = _twist(dynamics, trial.previous_command, trial.previous_command, trial.pose)
    late = before - steady
    size = late.std(dim=0).clamp(min=1e-9)
    along, squares = ((now - steady) * late / size**2).sum(dim=0), (late**2 / size**2).sum(dim=0).clamp(min=1e-9)
    left = along / squares
    if dynamics.robot.actuation.kind == "thrust":
        forward, aside, turn = (_lag_that_leaves(float(share), longest) for share in left)
        return (forward, aside, turn), 0.0
    lag = _lag_that_leaves(float(along[[0, 2]].sum() / squares[[0, 2]].sum()), longest)
    if not track_mm or lag <= 0:
        return (lag, lag, lag), 0.0
    rolled, rolls, rolled_before = (wheel_travel(twist, track_mm) for twist in (now, steady, before))
    lag, friction = _with_friction(rolled, rolls, rolled_before, lag, longest)
    return (lag, lag, lag), friction / dynamics.robot.period_s


def _with_friction(
    now: Tensor, steady: Tensor, before: Tensor, lag: float, longest: float, least: float = 0.05
) -> tuple[float, float]:
    """Return the time constant in periods, and the friction in mm a period, by which wheels follow best.

    There is no friction where it explains less than the `least` share of the squares that the lag alone leaves, or
    where it comes out as half of the largest speed, which is the most that is allowed.

    Args:
        now: (N, 2) how far they roll in the period of a new command, mm.
        steady: (N, 2) under that command for long.
        before: (N, 2) under the one before.
        lag: without friction.
        longest: that it may be with friction.
        least: see above.
    """

    def errors(values: np.ndarray) -> np.ndarray:
        lag, friction = map(float, values)
        predicted = steady + (before - steady) * left_over(1.0, lag)[0]
        if friction > 0:
            predicted = predicted + stopped_by_friction(before, steady, friction, lag, 1.0)[0]
        return (predicted - now).ravel().numpy()

    most = float(steady.abs().max()) / 2
    low, high = np.array([0.1 * lag, 0.0]), np.array([min(10 * lag, longest) + 1e-9, most])
    begin = np.array([min(lag, longest), 0.1 * most])
    fitted = optimize.least_squares(errors, begin, bounds=(low, high), x_scale=begin)
    following, friction = map(float, fitted.x)
    explains = 1 - 2 * fitted.cost / max(float((errors(np.array([lag, 0.0])) ** 2).sum()), 1e-12)
    if explains < least or friction > 0.99 * most:
        return lag, 0.0
    return min(following, longest), friction


def _lag_that_leaves(share: float, longest: float) -> float:
    """Return the time constant, in periods, of which this share of the old motion is left over a period, on average."""

    def excess(lag: float) -> float:
        return left_over(1.0, lag)[0] - share

    if share <= 0:
        return 0.0
    return longest if excess(longest) <= 0 else float(optimize.brentq(excess, 0.0, longest))


def _effort_exponents(dynamics: DynamicsModel, trial: TrialCommands) -> tuple[float, float, float]:
    """Return the power of the speed ahead with which steady twists of thrust grow, axis by axis; 1 for wheels.

    A twist v ∝ effortᵖ changes by p · v per unit of ln(effort): p is the slope of that change over v, from efforts a
    tenth larger and a tenth smaller, least squares through zero. Powers of effort itself would depend on the unit in
    which a command states it (thrust or its root); over the power of the speed ahead they do not, and a gain is the
    factor on that speed.
    """
    robot = dynamics.robot
    if robot.actuation.kind == "wheel" or not robot.actuation.effort:
        return 1.0, 1.0, 1.0
    columns = [robot.command_columns.index(name) for name in robot.actuation.effort]
    more, less = trial.command.clone(), trial.command.clone()
    more[:, columns] *= 1.1
    less[:, columns] *= 0.9
    inside = (more[:, columns] <= torch.as_tensor(robot.command_high)[columns]).all(dim=1)
    twist, up, down = (
        _twist(dynamics, command[inside], command[inside], trial.pose[inside])
        for command in (trial.command, more, less)
    )
    change = (up - down) / (math.log(1.1) - math.log(0.9))
    exponents = (change * twist).sum(dim=0) / (twist**2).sum(dim=0).clamp(min=1e-12)
    forward, left, turn = (min(max(float(power), 0.2), 4.0) for power in exponents)
    return 1.0, left / forward, turn / forward
