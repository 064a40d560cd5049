"""A differential drive simple enough to know all about: linear wheels with dead bands, exact arcs, noise."""

from pathlib import Path

import numpy as np
import yaml

from swarmtwin.geometry import compose
from swarmtwin.learning.recipe import Recipe
from swarmtwin.recordings.recording import Track
from swarmtwin.transitions import Transitions

CONF = Path(__file__).resolve().parents[1] / "conf"
GAIN_MM_S = {"left": 0.5, "right": 0.6}
DEAD_BAND = {"left": 10.0, "right": 14.0}
TRACK_MM = 80.0


def recipe(name="fast", **changes):
    """A shipped recipe, with changes."""
    return Recipe.parse({**yaml.safe_load((CONF / "recipe" / f"{name}.yaml").read_text()), **changes}, name)


def exact_displacement(command, period_s=0.5):
    """Displacements (N, 3) that follow commands (N, 2) left, right without noise, by elementary geometry."""
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


def toy_track(robot, steps, seed=0, run="run-0", vehicle="1"):
    """A noise-free run of `steps` commands: a track of steps + 1 rows."""
    random = np.random.default_rng(seed)
    command = random.uniform(-120, 120, (steps, 2))
    poses = [np.array([*random.uniform(200, 800, 2), random.uniform(-3, 3)])]
    for displacement in exact_displacement(command):
        poses.append(compose(poses[-1], displacement))
    time_s = robot.period_s * np.arange(steps + 1)
    return Track(run, vehicle, time_s, np.vstack([command, np.full((1, 2), np.nan)]), np.array(poses))


def toy_transitions(robot, count, noise=(0.0, 0.0, 0.0), seed=0, steps=50, mean=exact_displacement):
    """Transitions in runs of `steps`, a fifth of the runs for validation and a fifth for the test.

    Commands and poses are uniform; `mean` maps commands (N, m) to displacements (N, 3), `noise` is an sd each.
    """
    random = np.random.default_rng(seed)
    command = random.uniform(robot.command_low, robot.command_high, (count, len(robot.command)))
    low, high = robot.arena_mm.low_mm, robot.arena_mm.high_mm
    run = np.arange(count) // steps
    previous = np.roll(command, 1, axis=0)
    previous[np.arange(count) % steps == 0] = np.nan
    earlier = np.roll(previous, 1, axis=0)
    earlier[np.arange(count) % steps == 0] = np.nan
    return Transitions(
        robot=robot,
        arena_mm=robot.arena_mm,
        command=command,
        previous_command=previous,
        earlier_command=earlier,
        pose=np.column_stack([random.uniform(low, high, (count, 2)), random.uniform(-np.pi, np.pi, count)]),
        displacement=mean(command) + random.normal(0, 1, (count, 3)) * noise,
        neighbours=np.empty((count, 0, 3)),
        time_s=np.arange(count) * robot.period_s,
        duration_s=np.full(count, robot.period_s),
        run=run,
        vehicle=np.zeros(count, int),
        split=np.choose(run % 5, [0, 0, 0, 1, 2]),
        runs=tuple(f"run-{index}" for index in range(run[-1] + 1)),
        vehicles=("1",),
    )
