"""Real transitions of which everything is known: planted motion, planted noise, commands as an operator draws them."""

import dataclasses
from pathlib import Path

import numpy as np
import yaml

from swarmtwin.generators.generator import generator_config
from swarmtwin.transitions import Transitions
from swarmtwin.transitions.preparation import CountsByReason, Preparation, counts_by_split, runs_by_split
from swarmtwin.transitions.splitting import Fractions

CONF = Path(__file__).resolve().parents[2] / "conf"
NOISE = np.array([2.0, 1.0, 0.05])
QUICK = {
    "residual_diffusion": {
        "mean_model_steps": 250,
        "noise_steps": 350,
        "batch_size": 256,
        "mean_model_layers": [48, 48],
    },
    "gan": {"steps": 300},
    "dc_gan": {"steps": 150, "batch_size": 128, "discriminator_steps": 1},
    "fcc_gan": {"steps": 250, "batch_size": 128, "discriminator_steps": 1},
    "gmm_gan": {"steps": 300, "batch_size": 128, "discriminator_steps": 1},
    "cycle_gan": {"steps": 600, "batch_size": 128},
    "conditional_gan": {"steps": 300, "batch_size": 128, "discriminator_steps": 1, "situation_steps": 300},
    "conditional_diffusion": {"steps": 300, "batch_size": 256},
    "gaussian_mixture": {"components": 12, "iterations": 40},
}
BRIEF = {
    "residual_diffusion": {"mean_model_steps": 20, "noise_steps": 20},
    "gaussian_mixture": {"components": 3, "iterations": 3},
    "conditional_gan": {"steps": 20, "situation_steps": 10},
}
"""As good as no training: what most generators call `steps` is 20."""


def config(name, **changes):
    """A shipped generator's configuration, made quick, with changes."""
    shipped = yaml.safe_load((CONF / "generator" / f"{name}.yaml").read_text())
    return generator_config({**shipped, **QUICK[name], **changes}, name)


def brief_config(name, **changes):
    """A shipped generator's configuration, trained for next to nothing."""
    return config(name, **{**BRIEF.get(name, {"steps": 20}), **changes})


def explained(rows):
    """The share (3,) of the displacements' variance in rows (N, 5) that the planted motion explains."""
    displacement = rows[:, -3:]
    return 1 - (displacement - motion(rows[:, :2])).var(axis=0) / displacement.var(axis=0)


def motion(command):
    """The planted displacement (N, 3) of a two-wheeled robot: a dead band, and wheels that differ."""
    left, right = (np.sign(c) * np.maximum(np.abs(c) - 10, 0) for c in command.T)
    return np.stack([0.14 * left + 0.16 * right, 0.0 * left, 0.004 * (right - left)], axis=-1)


def planted(robot, count=4000, seed=0, steps=50, noise=NOISE):
    """Transitions of the MGR in runs of `steps`: four fifths for training, a tenth each to validate and to test."""
    random = np.random.default_rng(seed)
    command = random.uniform(robot.command_low, robot.command_high, (count, 2)).round(1)
    run = np.arange(count) // steps
    previous = np.roll(command, 1, axis=0)
    previous[np.arange(count) % steps == 0] = np.nan
    earlier = np.roll(previous, 1, axis=0)
    earlier[np.arange(count) % steps == 0] = np.nan
    runs = int(run[-1]) + 1
    return Transitions(
        robot=robot,
        arena_mm=robot.arena_mm,
        command=command,
        previous_command=previous,
        earlier_command=earlier,
        pose=np.column_stack([random.uniform(100, 900, (count, 2)), random.uniform(-np.pi, np.pi, count)]),
        displacement=motion(command) + random.normal(0, 1, (count, 3)) * noise,
        neighbours=np.empty((count, 0, 3)),
        time_s=np.arange(count) * robot.period_s,
        duration_s=np.full(count, robot.period_s),
        run=run,
        vehicle=np.zeros(count, int),
        split=np.array([0, 0, 0, 0, 1, 0, 0, 0, 0, 2], dtype=np.int8)[run % 10],
        runs=tuple(f"run-{index:04}" for index in range(runs)),
        vehicles=("1",),
    )


def swimming(robot, count=3000, seed=0, steps=50):
    """Transitions of the MUR: it swims forward with its amplitude, and is turned away from a wall ahead."""
    random = np.random.default_rng(seed)
    command = random.uniform(robot.command_low, robot.command_high, (count, 3)).round(1)
    low, high = robot.arena_mm.low_mm, robot.arena_mm.high_mm
    pose = np.column_stack([random.uniform(low + 60, high - 60, (count, 2)), random.uniform(-np.pi, np.pi, count)])
    moved = np.stack([command[:, 1] * share(pose), 0.0 * pose[:, 0], command[:, 0] / 200], axis=-1)
    base = planted(robot_like(robot), count, seed, steps)
    displacement = moved + random.normal(0, 1, (count, 3)) * [3, 3, 0.1]
    previous = np.full_like(command, np.nan)
    return dataclasses.replace(
        base, robot=robot, command=command, previous_command=previous, pose=pose, displacement=displacement
    )


def share(pose):
    """The planted share (N,) of its speed that the MUR keeps at poses (N, 3): less with the wall at 2 m ahead."""
    return 1 - 0.6 * np.exp(-(2000 - pose[:, 0]) / 150) * np.cos(pose[:, 2])


def robot_like(robot):
    """The robot with the two first of its commands, so that `planted` can drive it."""
    return robot.model_copy(update={"command": dict(list(robot.command.items())[:2])})


def preparation(transitions, **changes):
    """How such transitions came about."""
    about = {
        "robot": transitions.robot.name,
        "recording": "monday",
        "digest": "0123abcd",
        "source": "a test",
        "vehicles": ("1",),
        "fractions": Fractions(train=0.8, validation=0.1, test=0.1),
        "seed": 1,
        "counts": CountsByReason(rows=0, dropped_rows={}, considered=0, kept=0, dropped={}),
        "runs": runs_by_split(transitions),
        "transitions": counts_by_split(transitions),
        "learned": ("aa", "bb"),
    }
    return Preparation(**{**about, **changes})
