"""Step 4. Which drive would tell two rivals apart: commands under which they predict most differently."""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import torch

from swarmtwin.diagnosis.left_over import Explanation
from swarmtwin.diagnosis.reference import Reference
from swarmtwin.diagnosis.result import NextRecording
from swarmtwin.diagnosis.session_prediction import SessionPredictor
from swarmtwin.diagnosis.settings import NextRecordingSettings
from swarmtwin.learning.situation import Situation
from swarmtwin.robot import Robot
from swarmtwin.simulation.conditions import SessionConditions
from swarmtwin.simulation.mechanism import Mechanism
from swarmtwin.simulation.simulation import Simulation

DRIVE_FILE = "next_drive.csv"


def next_recording(
    reference: Reference, explained: Explanation, seed: int
) -> tuple[NextRecording | None, np.ndarray | None]:
    """Plan the drive that separates the first cause that has rivals from the nearest of them, and its commands (P, m).

    None where no reported cause has a rival.
    """
    posterior, settings = explained.posterior, explained.model.settings.search
    for name in explained.names:
        rivals = posterior.rivals(name, settings.rival_from)
        if rivals:
            rival = next(one for one in posterior.sets if rivals[0] in one.names and name not in one.names)
            conditions = explained.model.session.conditions
            return separating_drive(reference, conditions, explained.best.mechanisms, rival.mechanisms, seed)
    return None, None


def separating_drive(
    reference: Reference,
    conditions: SessionConditions,
    found: Sequence[Mechanism],
    rival: Sequence[Mechanism],
    seed: int,
) -> tuple[NextRecording, np.ndarray]:
    """Return the drive, of several candidates, under which two explanations differ most, and its commands (P, m).

    Expected nats are half the squared difference of what both predict, in units of the reference's noise.
    """
    settings = reference.settings.next_recording
    candidates = _candidates(reference.robot, settings, np.random.default_rng(seed))
    expected = [
        _expected_nats(reference, conditions, (found, rival), command, settings.steps) for command in candidates
    ]
    best = int(np.argmax(expected))
    nats_a_run = expected[best] * settings.steps / len(candidates[best])
    wanted = np.ceil(settings.enough_nats / max(nats_a_run, 1e-3))
    runs = int(np.clip(wanted, settings.fewest_runs, settings.most_runs))
    names = tuple(
        next(one.name for one in these if one.name not in {o.name for o in others})
        for these, others in ((found, rival), (rival, found))
    )
    plan = NextRecording(
        separates=names,
        drive=DRIVE_FILE,
        runs=runs,
        steps=settings.steps,
        expected_nats=float(nats_a_run * runs),
        command=f"swarmtwin record robot={reference.robot.name} drive={DRIVE_FILE} runs={runs} "
        f"steps={settings.steps} output=DIR",
    )
    return plan, candidates[best]


def _candidates(robot: Robot, settings: NextRecordingSettings, rng: np.random.Generator) -> list[np.ndarray]:
    """Return commands (P, m): at random, held, to and fro between the limits, likewise held for long, small ones."""
    low, high, periods = robot.command_low, robot.command_high, settings.periods
    uniform = rng.uniform(low, high, (periods, len(low)))
    held = np.repeat(rng.uniform(low, high, (periods // 4, len(low))), 4, axis=0)
    extremes = np.where(rng.random((periods, len(low))) < 0.5, low, high)
    long_held = np.repeat(np.where(rng.random((periods // 10, len(low))) < 0.5, low, high), 10, axis=0)
    middle = np.clip(0.0, low, high)
    small = middle + settings.small_share * (uniform - middle)
    return [np.round(command, 3) for command in (uniform, held, extremes, long_held, small)]


def _expected_nats(
    reference: Reference,
    conditions: SessionConditions,
    explanations: tuple[Sequence[Mechanism], Sequence[Mechanism]],
    command: np.ndarray,
    steps: int,
) -> float:
    situation = _driven(reference, conditions, command, steps)
    before = np.arange(len(command)) - 1
    before[::steps] = -1
    predictor = SessionPredictor(reference.base, conditions, situation, before)
    first, second = (predictor.most_likely_twist(mechanisms).numpy() for mechanisms in explanations)
    return float((((first - second) / reference.noise.spread(first)) ** 2).sum() / 2)


def _driven(reference: Reference, conditions: SessionConditions, command: np.ndarray, steps: int) -> Situation:
    """Drive the simulation open loop from the middle of the arena, back to it after each run; return P situations."""
    simulation, sent = Simulation(reference.base, (), conditions), torch.as_tensor(command)
    count = len(sent)
    previous = torch.cat([sent[:1], sent[:-1]])
    start = simulation.start(torch.cat([conditions.centre_mm, conditions.centre_mm.new_zeros(1)])[None, None])
    poses, velocities, state = [], [], start
    for step in range(count):
        if step % steps == 0:
            state = replace(start, previous_command=previous[step][None, None])
        poses.append(state.pose[0, 0])
        velocities.append(state.velocity[0, 0])
        state = simulation.step(state, sent[step][None, None])
    return Situation(
        command=sent,
        previous_command=previous,
        earlier_command=torch.cat([previous[:1], previous[:-1]]),
        pose=torch.stack(poses),
        velocity=torch.stack(velocities),
        elapsed_s=torch.arange(count).double() / count * conditions.session_s,
        duration_s=torch.full((count,), simulation.robot.period_s, dtype=torch.float64),
        neighbours=torch.zeros(count, 0, 3, dtype=torch.float64),
    )
