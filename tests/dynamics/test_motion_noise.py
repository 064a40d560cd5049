"""The spread that is estimated is the one that was there, the camera's part told from the motion's."""

import math

import numpy as np
import pytest
import torch

from swarmtwin.dynamics.motion_noise import MotionNoise
from swarmtwin.geometry import compose, displacement_between, exp_map, log_map
from swarmtwin.transitions import Transitions

TRUE = MotionNoise(
    at_rest=(1.0, 0.36, 4e-4), with_motion=(0.5, 0.04, 1e-4), usual_mm=20.0, usual_rad=0.5, camera=(0.5, 0.5, 2e-4)
)


def driven(robot, noise, runs=150, steps=40):
    """Transitions of vehicles with this noise, and the displacements that a perfect model expects."""
    rng, drawn = np.random.default_rng(0), torch.Generator().manual_seed(0)
    twist = torch.as_tensor(rng.normal(size=(steps, runs, 3)) * np.array([18.0, 0.5, 0.45]))
    pose = torch.zeros(runs, 3, dtype=torch.float64)
    measured = [noise.photograph(pose, drawn)]
    for now in twist:
        pose = compose(pose, noise.sample(exp_map(now), drawn))
        measured.append(noise.photograph(pose, drawn))
    poses = torch.stack(measured).numpy()
    step, run = np.tile(np.arange(steps), runs), np.repeat(np.arange(runs), steps)
    count, unknown = runs * steps, np.full((runs * steps, len(robot.command)), np.nan)
    transitions = Transitions(
        robot,
        robot.arena_mm,
        *(unknown, unknown, unknown),
        pose=poses[:-1][step, run],
        displacement=displacement_between(poses[:-1], poses[1:])[step, run],
        neighbours=np.empty((count, 0, 3)),
        time_s=(run * 100 + step) * robot.period_s,
        duration_s=np.full(count, robot.period_s),
        run=run,
        vehicle=np.zeros(count, dtype=int),
        split=np.zeros(count, dtype=int),
        runs=tuple(str(number) for number in range(runs)),
        vehicles=("1",),
    )
    return transitions, exp_map(twist).numpy()[step, run]


def test_motion_and_camera_are_told_apart(robots):
    transitions, expected = driven(robots["mgr"], TRUE)
    found = MotionNoise.estimate(transitions, expected)
    twist = np.array([20.0, 0.0, 0.5])
    size2 = 1 + 1

    def motion_sd(noise):
        scaled = (np.hypot(*twist[:2]) / noise.usual_mm) ** 2 + (twist[2] / noise.usual_rad) ** 2
        return np.sqrt(np.array(noise.at_rest) + np.array(noise.with_motion) * scaled)

    assert motion_sd(TRUE)[0] == pytest.approx(math.sqrt(1.0 + 0.5 * size2))
    np.testing.assert_allclose(motion_sd(found), motion_sd(TRUE), rtol=0.15)
    np.testing.assert_allclose(np.sqrt(found.camera), np.sqrt(TRUE.camera), rtol=0.2)


def test_without_a_camera_all_is_motion(robots):
    still = TRUE.model_copy(update={"camera": (0.0, 0.0, 0.0)})
    transitions, expected = driven(robots["mgr"], still)
    assert max(np.sqrt(MotionNoise.estimate(transitions, expected).camera)[:2]) < 0.2


def test_samples_have_the_spread_that_is_stated():
    drawn = torch.Generator().manual_seed(1)
    expected = torch.tensor([[20.0, 0.0, 0.5]], dtype=torch.float64).expand(20_000, 3)
    twist = log_map(TRUE.sample(exp_map(expected), drawn, factor=2.0)) - expected
    variance = np.array(TRUE.at_rest) + np.array(TRUE.with_motion) * 2
    np.testing.assert_allclose(twist.std(dim=0).numpy(), 2 * np.sqrt(variance), rtol=0.03)
    assert torch.equal(
        TRUE.sample(expected, torch.Generator().manual_seed(2)), TRUE.sample(expected, torch.Generator().manual_seed(2))
    )
