"""Looking ahead: means and spreads are those that the simulation itself draws."""

import numpy as np
import pytest
import torch
from playground import exact_simulation

from swarmtwin.deploy.control.look_ahead import Ahead, LookAhead
from tiny_policies import robot_named


def test_mean_and_spread_are_those_of_drawn_motion():
    robot = robot_named("mgr")
    simulation = exact_simulation(robot)
    state = simulation.start(torch.tensor([[[400.0, 500, 0.3], [700.0, 300, 2.0]]]))
    command = np.array([[100.0, 60.0], [-40.0, 80.0]])
    ahead = LookAhead(simulation, 1, 0.25)(state, command[None])
    rng = torch.Generator().manual_seed(1)
    many = simulation.start(state.pose.expand(4000, -1, -1))
    drawn = simulation.step(many, torch.as_tensor(command).expand(4000, -1, -1), rng=rng).pose[..., :2].numpy()
    assert np.abs(drawn.mean(axis=0) - ahead.position_mm[0, 1]).max() < 0.1
    widest = np.array([np.sqrt(np.linalg.eigvalsh(np.cov(drawn[:, one].T)).max()) for one in range(2)])
    stated = ahead.spread_mm[0, 1]
    assert (stated >= widest * 0.97).all()
    assert (stated <= widest * 1.5).all()


def test_a_vehicle_told_to_stand_has_no_spread_but_the_cameras():
    simulation = exact_simulation(robot_named("mgr"))
    state = simulation.start(torch.tensor([[[400.0, 500, 0.3]]]))
    ahead = LookAhead(simulation, 2, 0.25)(state, np.zeros((1, 1, 2)))
    assert ahead.spread_mm[0, :, 0] == pytest.approx([0.1, 0.1, 0.1])


def test_vehicles_that_pass_each_other_between_two_moments_are_nearest_in_between():
    position = np.zeros((1, 2, 2, 2))
    position[0, :, 0] = [[0, 0], [100, 0]]
    position[0, :, 1] = [[100, 30], [0, 30]]
    nearest, _ = Ahead(position, np.zeros((1, 2, 2))).nearest_mm()
    assert nearest[0, 0, 0, 0, 1] == pytest.approx(30)
    assert nearest[0, 0, 0, 0, 0] == 0


def test_a_vehicle_that_passes_an_obstacle_between_two_moments_is_nearest_in_between():
    position = np.array([[[[0.0, 0.0]], [[100.0, 0.0]], [[100.0, 0.0]]]])
    obstacles = np.array([[50.0, 60.0, 20.0], [900.0, 0.0, 20.0]])
    gap = Ahead(position, np.zeros((1, 3, 1))).gap_mm(obstacles)
    assert gap[0, :, 0] == pytest.approx([40.0, np.hypot(50, 60) - 20])
