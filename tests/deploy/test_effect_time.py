"""Where a vehicle will be when its command takes effect, against the motion itself."""

import numpy as np
import pytest
import torch
from playground import exact_simulation

from exact_model import simulation_with
from swarmtwin.deploy.control.effect_time import EffectTimePredictor
from swarmtwin.deploy.control.motion_delay import MotionDelay
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


@pytest.mark.parametrize("late_s", [0.0, 0.06, 0.12])
def test_a_delay_of_the_vehicles_is_found_in_their_motion(late_s):
    """Vehicles obey later than supposed; the poses are noisy; the estimate comes near in 40 periods."""
    simulation = exact_simulation(robot_named("mgr"))
    robot, rng = simulation.robot, np.random.default_rng(2)
    predictor, delay = EffectTimePredictor(simulation, 2), MotionDelay(robot.period_s, robot.displacement_limit)
    true, before = START, None
    old = np.zeros((2, 3))
    for period in range(40):
        now_s = 10 + period * robot.period_s
        seen = true + rng.normal(0, [0.3, 0.3, 0.003], (2, 3))
        if before is not None:
            delay.update(predictor, before, (seen, np.full(2, now_s)))
        before = (seen, np.full(2, now_s))
        command = rng.uniform(-120, 120, (2, 2))
        state = predictor.predict(seen, np.full(2, now_s), now_s)
        predictor.command_sent(state, command, now_s + delay.delay_s)
        new = simulation.dynamics.twist(torch.as_tensor(command)).numpy()
        share = late_s / robot.period_s
        true = compose(compose(true, exp_map(old * share)), exp_map(new * (1 - share)))
        old = new
    assert delay.delay_s == pytest.approx(late_s, abs=0.015)


def test_nothing_is_learned_of_a_delay_where_commands_do_not_change():
    simulation = exact_simulation(robot_named("mgr"))
    robot, rng = simulation.robot, np.random.default_rng(2)
    predictor, delay = EffectTimePredictor(simulation, 2), MotionDelay(robot.period_s, robot.displacement_limit)
    command = np.full((2, 2), 60.0)
    twist = simulation.dynamics.twist(torch.as_tensor(command)).numpy()
    true = START
    predictor.command_sent(predictor.predict(true, np.full(2, 1.0), 1.0), command, 1.0)
    for period in range(4, 40):
        at_s = np.full(2, period * robot.period_s)
        after = compose(true, exp_map(twist)) + rng.normal(0, [0.3, 0.3, 0.003], (2, 3))
        delay.update(predictor, (true, at_s), (after, at_s + robot.period_s))
        true = after
    assert delay.delay_s < 0.01
