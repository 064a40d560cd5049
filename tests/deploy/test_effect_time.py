"""Where a vehicle will be when its command takes effect, against the motion itself."""

import numpy as np
import pytest
import torch
from playground import exact_simulation

from exact_model import simulation_with
from swarmtwin.deploy.control.effect_time import EffectTimePredictor
from swarmtwin.geometry import compose, exp_map
from tiny_policies import robot_named

START = np.array([[300.0, 400.0, 0.5], [700.0, 600.0, -2.0]])


def test_a_pose_seen_before_a_command_takes_effect_is_moved_on_under_the_command_before():
    simulation = exact_simulation(robot_named("mgr"))
    period_s = simulation.robot.period_s
    predictor = EffectTimePredictor(simulation, 2)
    commands = np.random.default_rng(1).uniform(-120, 120, (6, 2, 2))
    effects_s = 10 + period_s * np.arange(7) + np.array([0, 0.01, -0.01, 0, 0.02, 0, 0])
    true, at_s = START, effects_s[0]
    for number, command in enumerate(commands):
        twist = simulation.dynamics.twist(torch.as_tensor(commands[number - 1])).numpy() if number else np.zeros((2, 3))
        seen_s = effects_s[number] - np.array([0.08, 0.15])  # two vehicles, two ages
        before = [np.maximum(seen_s - at_s, 0), effects_s[number] - at_s]
        seen, now = (compose(true, exp_map(twist * np.reshape(part, (-1, 1)) / period_s)) for part in before)
        if number == 0:
            seen = now
        state = predictor.predict(seen, seen_s, effects_s[number])
        assert predictor.measured(state) == pytest.approx(now, abs=1e-9)
        predictor.command_sent(state, command, effects_s[number])
        true, at_s = now, effects_s[number]
    assert (predictor.command_in_force(effects_s[5] + 0.1) == commands[5]).all()
    assert (predictor.command_in_force(effects_s[3] + 0.1) == commands[3]).all()
    assert (predictor.command_in_force(1.0) == 0).all()


def test_a_vehicle_that_was_not_seen_is_carried_on_by_the_simulation():
    simulation = exact_simulation(robot_named("mgr"))
    predictor = EffectTimePredictor(simulation, 2)
    state = predictor.predict(START, np.array([10.0, 10.0]), 10.0)
    command = np.array([[60.0, 80.0], [90.0, 20.0]])
    predictor.command_sent(state, command, 10.0)
    unseen = START.copy()
    unseen[1] = np.nan
    state = predictor.predict(unseen, np.array([10.0, np.nan]), 10.5)
    moved = compose(START, exp_map(simulation.dynamics.twist(torch.as_tensor(command)).numpy()))
    assert predictor.measured(state) == pytest.approx(moved)


def test_markers_and_actuators_of_an_extended_simulation_are_carried_along():
    simulation = simulation_with(
        robot_named("mgr"), marker_offset={"forward_mm": 20.0, "left_mm": 0.0}, actuator_lag={"time_constant_s": 0.3}
    )
    predictor = EffectTimePredictor(simulation, 2)
    state = predictor.predict(START, np.array([10.0, 10.0]), 10.0)
    assert predictor.measured(state) == pytest.approx(START)
    predictor.command_sent(state, np.full((2, 2), 100.0), 10.0)
    first = predictor.held[-1].twist[0, 0]
    state = predictor.predict(START, np.array([10.0, 10.0]), 10.5)
    predictor.command_sent(state, np.full((2, 2), 100.0), 10.5)
    assert 1.2 * first < predictor.held[-1].twist[0, 0] < 35.0  # still speeding up
