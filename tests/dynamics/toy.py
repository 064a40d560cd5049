"""A differential drive simple enough to know everything about: linear wheels, exact arcs, white noise."""

import numpy as np

from swarmtwin.geometry import compose
from swarmtwin.recordings.recording import Track
from swarmtwin.transitions import Transitions

GAIN_MM_S = {"left": 0.5, "right": 0.6}
DEAD_BAND = {"left": 10.0, "right": 14.0}
TRACK_MM = 80.0


def exact_displacement(command, period_s=0.5):
    """Displacements (N, 3) that follow commands (N, 2) left, right without noise."""
    left, right = (
        GAIN_MM_S[wheel] * np.sign(command[:, i]) * np.maximum(np.abs(command[:, i]) - DEAD_BAND[wheel], 0)
        for i, wheel in enumerate(("left", "right"))
    )
    turn = (right - left) / TRACK_MM * period_s
    distance = (left + right) / 2 * period_s
    straight = np.abs(turn) < 1e-9
    radius = distance / np.where(straight, 1, turn)
    forward = np.where(straight, distance, radius * np.sin(turn))
    sideways = np.where(straight, 0, radius * (1 - np.cos(turn)))
    return np.stack([forward, sideways, turn], axis=-1)


def toy_tracks(robot, runs, steps, seed=0, vehicle="1"):
    """Noise-free runs of `steps` commands each, as tracks of steps + 1 rows."""
    random = np.random.default_rng(seed)
    tracks = []
    for run in range(runs):
        command = random.uniform(-120, 120, (steps, 2))
        poses = [np.array([*random.uniform(200, 800, 2), random.uniform(-3, 3)])]
        for displacement in exact_displacement(command):
            poses.append(compose(poses[-1], displacement))
        time_s = 1000 * run + robot.period_s * np.arange(steps + 1)
        command = np.vstack([command, np.full((1, 2), np.nan)])
        tracks.append(Track(f"run-{run}", vehicle, time_s, command, np.array(poses)))
    return tracks


def toy_transitions(robot, count, noise=(0.0, 0.0, 0.0), seed=0, steps=50, command=None, mean=None):
    """Transitions in runs of `steps`, a fifth of the runs for validation and a fifth for the test."""
    random = np.random.default_rng(seed)
    if command is None:
        command = random.uniform(robot.command_low, robot.command_high, (count, len(robot.command)))
    mean = exact_displacement(command) if mean is None else mean
    low, high = robot.arena_mm.low_mm, robot.arena_mm.high_mm
    run = np.arange(count) // steps
    first = np.arange(count) % steps == 0
    previous = np.roll(command, 1, axis=0)
    previous[first] = np.nan
    return Transitions(
        robot=robot,
        command=command,
        previous_command=previous,
        pose=np.column_stack([random.uniform(low, high, (count, 2)), random.uniform(-np.pi, np.pi, count)]),
        displacement=mean + random.normal(0, 1, (count, 3)) * noise,
        time_s=np.arange(count) * robot.period_s,
        duration_s=np.full(count, robot.period_s),
        run=run,
        vehicle=np.zeros(count, int),
        split=np.choose(run % 5, [0, 0, 0, 1, 2]),
        runs=tuple(f"run-{index}" for index in range(run[-1] + 1)),
        vehicles=("1",),
    )
