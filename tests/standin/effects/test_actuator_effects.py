"""Actuator effects, delay included, against the wheels' and fin's own equations."""

import numpy as np
from pairs import first_periods, session, true_displacements

from swarmtwin.standin.effect import Placement
from swarmtwin.standin.effects import parse_effects
from swarmtwin.standin.exact_means import mean_given_state
from swarmtwin.standin.session import drive_session


def test_gain_change_multiplies_the_wheels_way(robots):
    plain, changed, _ = first_periods(robots["mgr"], {"name": "gain_change", "gain": 0.7})
    np.testing.assert_allclose(changed[..., 2], 0.7 * plain[..., 2], atol=1e-9)


def test_actuator_asymmetry_makes_the_left_wheel_faster_and_trims_the_fin(robots):
    plain, changed, command = first_periods(robots["mgr"], {"name": "actuator_asymmetry", "ratio": 1.21})
    ahead = (command > 60).all(axis=-1)
    assert (changed[ahead][:, 2] < plain[ahead][:, 2]).all()
    only_left = np.abs(command[..., 1]) < 10
    np.testing.assert_allclose(changed[only_left][:, 2], 1.1 * plain[only_left][:, 2], atol=1e-9)
    plain, changed, _ = first_periods(robots["mur"], {"name": "actuator_asymmetry", "angle_rad": 0.2})
    assert np.mean(changed[..., 2] - plain[..., 2]) > 0.02


def test_dead_band_takes_small_commands_and_leaves_large_ones(robots):
    plain, changed, command = first_periods(robots["mgr"], {"name": "dead_band", "width": 40})
    small = (np.abs(command) < 40).all(axis=-1)
    large = (np.abs(command) >= 40).all(axis=-1)
    np.testing.assert_allclose(changed[small], 0, atol=1e-9)
    np.testing.assert_array_equal(changed[large], plain[large])


def test_saturation_leaves_small_commands_alone_and_cuts_large_ones(robots):
    for name, limit, column in (("mgr", 60, slice(None)), ("mur", 30, slice(1, 2))):
        plain, changed, command = first_periods(robots[name], {"name": "saturation", "limit": limit})
        small = (np.abs(command[..., column]) <= limit).all(axis=-1)
        np.testing.assert_array_equal(changed[small], plain[small])
        assert np.abs(changed[~small][:, 0]).mean() < 0.9 * np.abs(plain[~small][:, 0]).mean()


def test_command_delay_moves_the_motion_by_the_delay(robots):
    """From rest, the wheels have been driven for that much less than the period."""
    robot = robots["mgr"]
    for delay_s in (0.05, 0.2, 0.437):
        driven = drive_session(session(robot, {"name": "command_delay", "delay_s": delay_s}, runs=200, steps=1))
        physics = driven.session.physics(("1", "2"))
        wanted = physics.target(np.moveaxis(driven.command[:, 0], -1, 0), 1.0)
        reached = 1 - np.exp(-(0.5 - delay_s) / physics.unit.time_constant_s)
        np.testing.assert_allclose(driven.state[3:5, :, 1], wanted * reached, atol=1.0)


def test_actuator_lag_adds_to_the_time_constant(robots):
    robot = robots["mgr"]
    plain, changed = (
        drive_session(session(robot, *entries, runs=200, steps=1))
        for entries in ((), ({"name": "actuator_lag", "time_constant_s": 0.2},))
    )
    lag_s = plain.session.physics(("1", "2")).unit.time_constant_s
    expected = (1 - np.exp(-0.5 / (lag_s + 0.2))) / (1 - np.exp(-0.5 / lag_s))
    np.testing.assert_allclose(changed.state[3:5, :, 1], expected * plain.state[3:5, :, 1], atol=1e-9)


def test_backlash_costs_its_travel_at_each_reversal_and_nothing_between(robots):
    robot = robots["mgr"]
    drive = np.array([[60, 60], [60, 60], [-60, -60], [-60, -60]], float)
    plain, changed = (
        mean_given_state(drive_session(session(robot, *entries, runs=1, steps=4, drive=drive)))[0, :, 0, 0]
        for entries in ((), ({"name": "backlash", "travel_mm": 6},))
    )
    slip_kept = 1 - 0.04
    np.testing.assert_allclose(changed[1], plain[1], atol=0.1)
    np.testing.assert_allclose(changed[3], plain[3], atol=0.1)
    np.testing.assert_allclose(np.abs(plain[2] - changed[2]), 6 * slip_kept, atol=0.3)


def test_a_fins_play_takes_half_of_itself_from_the_stroke_and_a_fin_that_stands_pushes_nothing(robots):
    robot = robots["mur"]

    def forward_mm(amplitude_deg, *entries):
        """In the third period, of most runs: few are led back from the wall by then."""
        drive = np.array([[0.0, amplitude_deg, 6.0]])
        driven = drive_session(session(robot, *entries, runs=60, steps=3, drive=drive))
        return np.median(mean_given_state(driven)[:, 2, :, 0])

    play = {"name": "backlash", "travel_rad": np.deg2rad(24)}
    # it waits at the ends of its stroke, and is as fast between them as one of the whole amplitude
    assert forward_mm(28.0) < forward_mm(40.0, play) < forward_mm(34.0) < forward_mm(40.0)
    assert abs(forward_mm(10.0, play)) < 0.05 * forward_mm(10.0)


def test_battery_sag_begins_with_nothing_and_grows_to_its_loss(robots):
    robot = robots["mgr"]
    plain, changed = (
        drive_session(session(robot, *entries, runs=60, steps=10))
        for entries in ((), ({"name": "battery_sag", "loss": 0.4},))
    )
    strength = 1 - 0.4 * plain.session.progress(plain.time_s[:, :1])
    turn_rad, fresh_turn_rad = (true_displacements(driven)[:, 0, :, 2] for driven in (changed, plain))
    np.testing.assert_allclose(turn_rad, strength * fresh_turn_rad, atol=1e-9)
    assert strength[0] == 1
    assert 0.6 < strength[-1] < 0.61


def test_a_battery_of_another_shape_sags_late(robots):
    robot = robots["mgr"]
    late = parse_effects([{"name": "battery_sag", "loss": 0.4, "shape": 3}], robot, 1)[0]
    progress = np.array([0.0, 0.5, 1.0])
    none = np.zeros(3)
    np.testing.assert_allclose(late.strength(Placement(progress, none, none, none, none, none)), [1, 0.95, 0.6])
