"""Simulations that are known exactly, and sessions in which what really happens is written down here."""

from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor

from exact_model import ExactDynamics, conditions_of
from swarmtwin.diagnosis.measured_session import MeasuredSession
from swarmtwin.diagnosis.noise import Noise
from swarmtwin.diagnosis.reference_errors import ReferenceErrors
from swarmtwin.geometry import compose, displacement_between, exp_map, log_map
from swarmtwin.transitions import Transitions

SPREAD = (1.0, 1.0, 0.02)


class ExactBase(ExactDynamics):
    """The exact model as a diagnosis takes one: without members that could differ."""

    members = 0


class Moment(NamedTuple):
    """What R vehicles, one a run, do in one period: commands (R, m), true poses (R, 3), number of the period."""

    base: ExactBase
    command: Tensor
    previous_command: Tensor
    pose: Tensor
    step: int

    @property
    def way(self):
        return self.base.twist(self.command)

    @property
    def way_before(self):
        return self.base.twist(self.previous_command)


def as_simulated(moment):
    """True displacements (R, 3)."""
    return exp_map(moment.way)


class Losing:
    """Each command is lost with a probability, and what was held before goes on; otherwise vehicles go as `moved`."""

    def __init__(self, probability, seed, moved=as_simulated):
        self.probability, self.rng, self.moved, self.held = probability, np.random.default_rng(seed), moved, None

    def __call__(self, moment):
        """True displacements (R, 3)."""
        if moment.step == 0:
            self.held = moment.previous_command
        before = self.held
        lost = torch.as_tensor(self.rng.random(len(moment.command)) < self.probability)[:, None]
        self.held = torch.where(lost, before, moment.command)
        return self.moved(moment._replace(command=self.held, previous_command=before))


def as_it_is(pose):
    """Measured poses (R, 3) of true ones."""
    return pose


def still(way):
    """No spread, (R, 3)."""
    return torch.zeros_like(way)


def steady_spread(way):
    """Standard deviation (R, 3) of the ways."""
    return torch.tensor(SPREAD, dtype=torch.float64).expand_as(way)


def session_of(
    base,
    rng,
    moved=as_simulated,
    seen=as_it_is,
    spread=steady_spread,
    camera=None,
    runs=60,
    steps=30,
    vehicle="1",
    command=None,
):
    """Drive R vehicles by random commands: `moved` says where they truly go, `seen` what the camera measures of it.

    Instead of random ones, commands (steps, R, m) may be given.
    Gaussian noise of standard deviation `spread` is added to the ways, and of `camera` to the measured poses.
    """
    robot = base.robot
    rest = np.clip(np.zeros(len(robot.command)), robot.command_low, robot.command_high)
    if command is None:
        command = rng.uniform(robot.command_low, robot.command_high, (steps, runs, len(robot.command)))
    steps, runs = command.shape[:2]
    previous = np.concatenate([np.tile(rest, (1, runs, 1)), command[:-1]])
    arena = robot.arena_mm
    inner = arena.low_mm + 0.3 * (arena.high_mm - arena.low_mm), arena.low_mm + 0.7 * (arena.high_mm - arena.low_mm)
    start = np.column_stack([rng.uniform(*inner, (runs, 2)), rng.uniform(-3.1, 3.1, runs)])
    pose = torch.as_tensor(start)
    measured = [_photographed(pose, seen, camera, rng)]
    for step in range(steps):
        moment = Moment(base, torch.as_tensor(command[step]), torch.as_tensor(previous[step]), pose, step)
        way = log_map(moved(moment))
        way = way + spread(way) * torch.as_tensor(rng.normal(size=way.shape))
        pose = compose(pose, exp_map(way))
        measured.append(_photographed(pose, seen, camera, rng))
    poses = torch.stack(measured).numpy()
    before, earlier = np.full((2, *command.shape), np.nan)
    before[1:], earlier[2:] = command[:-1], command[:-2]
    by_run = np.tile(np.arange(steps), runs), np.repeat(np.arange(runs), steps)
    displacement = displacement_between(poses[:-1], poses[1:])
    taken = [values[by_run] for values in (command, before, earlier, poses[:-1], displacement)]
    transitions = Transitions(
        robot,
        robot.arena_mm,
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
    return MeasuredSession.of(transitions, conditions_of(robot))


def _photographed(pose, seen, camera, rng):
    if camera is None:
        return seen(pose)
    return seen(pose) + torch.as_tensor(rng.normal(size=pose.shape) * camera)


def known_noise(spread=SPREAD):
    """The noise of `steady_spread`, as it is, of a camera that measures exactly."""
    growth = np.column_stack([np.array(spread) ** 2, np.zeros((3, 2))])
    return Noise(np.array([20.0, 0.5]), growth, 0.0, np.zeros(3), None)


def errors_showing(**answers: float) -> ReferenceErrors:
    """The errors of a reference of which some answers are known."""
    errors = ReferenceErrors()
    vars(errors).update(answers)  # where they are kept, once asked
    return errors
