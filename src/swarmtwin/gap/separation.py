"""Which drive would tell two rivals apart: commands under which they predict most differently."""

from collections.abc import Sequence

import numpy as np
import torch

from swarmtwin.dynamics.twist import displacement_of, twist_of
from swarmtwin.gap.base import AnyBase
from swarmtwin.gap.diagnosis import NextRecording
from swarmtwin.gap.mechanism import Drive, Mechanism
from swarmtwin.gap.motion import likeliest_displacement
from swarmtwin.gap.noise import Noise
from swarmtwin.gap.surroundings import Surroundings
from swarmtwin.geometry import compose
from swarmtwin.robot import Robot

PERIODS = 400
STEPS = 40
ENOUGH_NATS = 10.0
MOST_RUNS = 400
DRIVE_FILE = "next_drive.csv"


def separating_drive(
    base: AnyBase,
    noise: Noise,
    surroundings: Surroundings,
    named: Sequence[Mechanism],
    rival: Sequence[Mechanism],
    seed: int,
) -> tuple[NextRecording, np.ndarray]:
    """Return the drive, of several manners, under which two explanations differ most, and its commands (P, m).

    Expected nats are half the squared difference of what both predict, in units of the reference's noise.
    """
    rng = np.random.default_rng(seed)
    robot = base.robot
    best, most = None, -1.0
    for command in _manners(robot, rng):
        nats = _expected_nats(base, noise, surroundings, (named, rival), command)
        if nats > most:
            best, most = command, nats
    assert best is not None
    a_run = most * STEPS / len(best)
    runs = int(np.clip(np.ceil(ENOUGH_NATS / max(a_run, 1e-3)), 8, MOST_RUNS))
    names = tuple(
        next(one.name for one in these if one.name not in {o.name for o in others})
        for these, others in ((named, rival), (rival, named))
    )
    command_line = f"swarmtwin record robot={robot.name} drive={DRIVE_FILE} runs={runs} steps={STEPS} output=DIR"
    plan = NextRecording(
        separates=names,
        drive=DRIVE_FILE,
        runs=runs,
        steps=STEPS,
        expected_nats=float(a_run * runs),
        command=command_line,
    )
    return plan, best


def _manners(robot: Robot, rng: np.random.Generator) -> list[np.ndarray]:
    """Return commands (P, m) of several manners: at random, held, to and fro between the limits, small ones."""
    low, high = robot.command_low, robot.command_high
    uniform = rng.uniform(low, high, (PERIODS, len(low)))
    held = np.repeat(rng.uniform(low, high, (PERIODS // 4, len(low))), 4, axis=0)
    extremes = np.where(rng.random((PERIODS, len(low))) < 0.5, low, high)
    long_held = np.repeat(np.where(rng.random((PERIODS // 10, len(low))) < 0.5, low, high), 10, axis=0)
    middle = np.clip(0.0, low, high)
    small = middle + 0.3 * (uniform - middle)
    return [np.round(command, 3) for command in (uniform, held, extremes, long_held, small)]


def _expected_nats(
    base: AnyBase,
    noise: Noise,
    surroundings: Surroundings,
    explanations: tuple[Sequence[Mechanism], Sequence[Mechanism]],
    command: np.ndarray,
) -> float:
    drive = _driven(base, surroundings, command)
    ways = [twist_of(likeliest_displacement(base, mechanisms, drive)) for mechanisms in explanations]
    spread = (
        torch.cat([torch.ones(len(command), 1), (ways[0] / noise.usual).abs(), (ways[0] / noise.usual) ** 2], dim=-1)
        @ noise.log_spread[:7]
    ).exp()
    return float((((ways[0] - ways[1]) / spread) ** 2).sum() / 2)


def _driven(base: AnyBase, surroundings: Surroundings, command: np.ndarray) -> Drive:
    """Drive the simulation open loop from the middle of the arena, back to it after each run."""
    sent = torch.as_tensor(command)
    count = len(sent)
    previous = torch.cat([sent[:1], sent[:-1]])
    pose = torch.zeros(count, 3, dtype=torch.float64)
    start = torch.cat([surroundings.centre_mm, torch.zeros(1, dtype=torch.float64)])
    here = start
    for step in range(count):
        here = start if step % STEPS == 0 else here
        pose[step] = here
        way = base.way(sent[step : step + 1], previous[step : step + 1], here[None])
        here = compose(here[None], displacement_of(way))[0]
    period_s = base.robot.period_s
    return Drive(
        robot=base.robot,
        surroundings=surroundings,
        command=sent,
        previous_command=previous,
        earlier_command=torch.cat([previous[:1], previous[:-1]]),
        pose=pose,
        elapsed_s=torch.arange(count).double() / count * surroundings.session_s,
        duration_s=torch.full((count,), period_s, dtype=torch.float64),
        neighbours=torch.zeros(count, 0, 3, dtype=torch.float64),
    )
