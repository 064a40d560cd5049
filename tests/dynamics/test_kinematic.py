from itertools import pairwise

import numpy as np
import pytest
import torch

from swarmtwin.dynamics.models.kinematic import Config, KinematicModel
from swarmtwin.dynamics.training import train
from swarmtwin.geometry import compose, integrate_twist
from toy import DEAD_BAND, GAIN_MM_S, TRACK_MM, recipe, toy_transitions


def fitted(transitions, steps):
    return train(transitions, Config(steps=steps), recipe(batch_size=128), seeds=[0]).dynamics


def planted_transitions(robot, planted, seed=1):
    """Noise-free transitions of a kinematic model with the planted values."""
    network = KinematicModel(robot)
    with torch.no_grad():
        for name, value in planted.items():
            parameter = network.parameters_by_name[name]
            free = value / parameter.size if parameter.signed else np.log(value / parameter.size)
            network.free[name].fill_(free)

        def mean(command):
            return network(torch.as_tensor(command, dtype=torch.float32)).numpy().astype(float)

        return toy_transitions(robot, 3000, seed=seed, mean=mean)


def test_a_twist_held_is_the_limit_of_many_small_steps():
    velocities = np.array([40.0, -25.0, 2.5])
    pose = np.zeros(3)
    steps = 20_000
    for _ in range(steps):
        pose = compose(pose, velocities / steps * 0.8)
    exact = integrate_twist(torch.tensor(velocities), 0.8).numpy()
    np.testing.assert_allclose(exact, pose, atol=1e-2)


def test_two_twists_held_one_after_the_other_are_one_held_longer():
    twist = torch.tensor([30.0, 10.0, -1.7], dtype=torch.float64)
    half, whole = (integrate_twist(twist, duration) for duration in (0.4, 0.8))
    torch.testing.assert_close(compose(half, half), whole)


def test_a_twist_without_turn_has_finite_gradients():
    turn = torch.zeros(1, requires_grad=True)
    integrate_twist(torch.stack([torch.ones(1), torch.zeros(1), turn], dim=-1), 0.5)[0, 1].backward()
    torch.testing.assert_close(turn.grad, torch.tensor([0.125]))  # left = v ω T² / 2


def test_the_planted_differential_drive_is_recovered(robots):
    dynamics = fitted(toy_transitions(robots["mgr"], 3000), steps=3000)
    found = dynamics.network.physical_parameters()
    assert found["track_mm"] == pytest.approx(TRACK_MM, rel=0.01)
    for wheel in ("left", "right"):
        assert found[f"{wheel}_gain_mm_s_per_unit"] == pytest.approx(GAIN_MM_S[wheel], rel=0.02)
        assert found[f"{wheel}_dead_band"] == pytest.approx(DEAD_BAND[wheel], abs=0.5)
        assert found[f"{wheel}_curvature"] == pytest.approx(0, abs=0.03)


def test_the_planted_unicycle_is_recovered(robots):
    planted = {"speed_gain": 0.85, "turn_gain": 1.2, "veer_rad_per_mm": 8e-4}
    transitions = planted_transitions(robots["create"], planted)
    assert fitted(transitions, steps=1000).network.physical_parameters() == pytest.approx(planted, rel=0.01)


def test_the_planted_tail_fin_is_recovered(robots):
    planted = {
        "push_mm_s": 45.0,
        "push_exponent": 1.2,
        "coasting_mm_s": 9.0,
        "side_mm_s": -12.0,
        "turn_rad_s": 0.6,
        "turn_exponent": 0.7,
        "side_exponent": 1.4,
        "angle_gain": 1.3,
        "trim_deg": 4.0,
    }
    transitions = planted_transitions(robots["mur"], planted)
    assert fitted(transitions, steps=2000).network.physical_parameters() == pytest.approx(planted, rel=0.03)


def test_a_wheel_in_its_dead_band_stands_and_moves_faster_beyond(robots):
    dynamics = fitted(toy_transitions(robots["mgr"], 3000), steps=500)
    both = np.array([0.0, 5.0, 40.0, 80.0, 120.0])
    moved = dynamics.network(torch.tensor(np.column_stack([both, both]), dtype=torch.float32))[:, 0].tolist()
    assert moved[0] == moved[1] == 0
    assert all(slower < faster for slower, faster in pairwise(moved[1:]))
