"""Every effect as physics: it changes the motion in the direction and by the size that mechanics says."""

import numpy as np
import pytest
from rigid_drives import (
    CALM,
    drive,
    held_displacements,
    measured_displacements,
    steady_displacement,
    true_displacements,
)
from scipy.optimize import brentq

AHEAD = (100.0, 100.0)


@pytest.fixture(scope="module")
def mgr(robots):
    return robots["mgr"]


@pytest.fixture(scope="module")
def speed_line(mgr):
    """Slope and intercept of the displacement over the command: a motor's line, shifted by Coulomb friction."""
    low, high = (steady_displacement(mgr, (pwm, pwm))[0] for pwm in (60.0, 120.0))
    slope = (high - low) / 60
    return slope, high - 120 * slope


def shares(driven):
    """Return by least squares how much of a command's turn comes in its own period and in the next: (own, next)."""
    drive_by = np.diff(driven.command[:, :, 0], axis=-1)[..., 0]
    before = np.concatenate([np.zeros_like(drive_by[:, :1]), drive_by[:, :-1]], axis=1)
    design = np.stack([drive_by.ravel(), before.ravel()], axis=1)
    own, later = np.linalg.lstsq(design, true_displacements(driven)[:, :, 0, 2].ravel())[0]
    return own, later


def test_gain_change_is_another_wheel_and_multiplies_the_way(mgr):
    plain = steady_displacement(mgr, AHEAD)
    changed = steady_displacement(mgr, AHEAD, {"name": "gain_change", "gain": 0.9})
    assert changed[0] / plain[0] == pytest.approx(0.9, abs=0.004)


def test_command_delay_shifts_the_turn_behind_its_command(mgr):
    plan = {"runs": 15, "steps": 20}
    own, later = shares(drive(mgr, **plan))
    late_own, late_later = shares(drive(mgr, {"name": "command_delay", "delay_s": 0.15}, **plan))
    shift = late_later / (late_own + late_later) - later / (own + later)
    assert shift == pytest.approx(0.15 / 0.5, abs=0.03)
    assert late_own + late_later == pytest.approx(own + later, rel=0.03)


def test_command_loss_lets_the_old_command_go_on(mgr):
    driven = drive(mgr, {"name": "command_loss", "probability": 0.2}, runs=50, steps=20)
    held, sent = np.moveaxis(driven.active_command, 0, -1)[:, :, 0], driven.command[:, :, 0]
    lost = (held[:, 1:] != sent).any(axis=-1)
    assert lost.mean() == pytest.approx(0.2, abs=4 * np.sqrt(0.2 * 0.8 / lost.size))
    turn = true_displacements(driven)[:, :, 0, 2]
    by_held, by_sent = (np.corrcoef(np.diff(told, axis=-1)[lost, 0], turn[lost])[0, 1] for told in (held[:, 1:], sent))
    assert by_held > 0.95
    assert by_sent < 0.3


def test_actuator_lag_is_added_to_the_time_constant_of_the_start(mgr):
    def time_constant_s(*effects):
        """Solve v · τ · (1 − exp(−T / τ)) = the way that a start from rest falls behind."""
        start, steady = (held_displacements(mgr, AHEAD, CALM, *effects, steps=steps)[0, 0] for steps in (1, 4))
        behind_s = 0.5 * (1 - start / steady)
        return brentq(lambda tau: tau * (1 - np.exp(-0.5 / tau)) - behind_s, 1e-3, 2)

    plain_s = time_constant_s()
    assert 0.02 < plain_s < 0.06
    assert time_constant_s({"name": "actuator_lag", "time_constant_s": 0.15}) - plain_s == pytest.approx(0.15, rel=0.05)


def test_dead_band_and_saturation_cut_commands_and_leave_the_others(mgr):
    band, limit = {"name": "dead_band", "width": 30}, {"name": "saturation", "limit": 72}
    assert abs(steady_displacement(mgr, (29.0, 29.0), band)[0]) < 0.02
    assert steady_displacement(mgr, (31.0, 31.0), band)[0] == steady_displacement(mgr, (31.0, 31.0))[0]
    assert steady_displacement(mgr, (120.0, 120.0), limit)[0] == steady_displacement(mgr, (72.0, 72.0))[0]


def test_battery_sag_takes_voltage_so_friction_takes_a_larger_share(mgr, speed_line):
    """At the session's end, a motor gets 0.7 of its voltage, and its friction is what it was."""
    sag = {"name": "battery_sag", "loss": 0.3}
    driven = drive(mgr, CALM, sag, runs=30, steps=3, drive=np.array([AHEAD]))
    moved = true_displacements(driven)[:, 2, 0, 0]
    progress = driven.session.progress(driven.time_s[:, 2])
    as_told = (driven.command[:, :, 0] == AHEAD).all(axis=(1, 2))
    slope, shift = speed_line
    assert shift < -1
    expected = slope * 100 * (1 - 0.3 * progress) + shift
    np.testing.assert_allclose(moved[as_told], expected[as_told], rtol=0.01)


def test_actuator_asymmetry_is_two_voltages(mgr, speed_line):
    slope, shift = speed_line
    left, right = (slope * 80 * factor + shift for factor in (1.2**0.5, 1.2**-0.5))
    plain = steady_displacement(mgr, (80.0, 80.0))
    changed = steady_displacement(mgr, (80.0, 80.0), {"name": "actuator_asymmetry", "ratio": 1.2})
    assert changed[2] - plain[2] == pytest.approx((right - left) / 70, rel=0.05)


def test_backlash_loses_its_play_at_each_reversal(mgr):
    """A little less, for a rotor without its load crosses the play faster."""
    to_and_fro = {"runs": 1, "steps": 6, "drive": np.array([[70, 70], [70, 70], [-70, -70], [-70, -70]], float)}
    plain = true_displacements(drive(mgr, CALM, **to_and_fro))[0, :, 0, 0]
    worn = true_displacements(drive(mgr, CALM, {"name": "backlash", "travel_mm": 6}, **to_and_fro))[0, :, 0, 0]
    lost = np.abs(plain) - np.abs(worn)
    np.testing.assert_allclose(lost[[2, 4]], 5.4, atol=0.6)
    np.testing.assert_allclose(lost[[1, 3, 5]], 0, atol=0.3)


def test_a_patch_takes_its_share_of_the_way_inside_and_nothing_outside(mgr):
    everywhere = {"name": "surface_patch", "loss": 0.4, "radius_mm": 900}
    assert steady_displacement(mgr, AHEAD, everywhere)[0] / steady_displacement(mgr, AHEAD)[0] == pytest.approx(
        0.6, abs=0.01
    )
    plan = {"runs": 12, "steps": 6}
    patch = {"name": "surface_patch", "loss": 0.4, "radius_mm": 200, "x_mm": 515, "y_mm": 515}
    plain, slowed = drive(mgr, CALM, **plan), drive(mgr, CALM, patch, **plan)
    away_mm = np.hypot(plain.state[0] - 515, plain.state[1] - 515)[..., 0]
    outside = (away_mm > 250).all(axis=1)
    assert 0 < outside.sum() < 12
    np.testing.assert_array_equal(slowed.state[:, outside], plain.state[:, outside])


def test_one_wheel_on_the_patch_turns_the_car_towards_it(mgr):
    """The other wheel goes on: what a disc that slows whole vehicles would not show."""
    half = {"name": "surface_patch", "loss": 0.4, "radius_mm": 4000, "x_mm": 4515, "y_mm": 515}
    plan = {"runs": 200, "steps": 3, "drive": np.array([AHEAD])}
    plain, slowed = drive(mgr, CALM, **plan), drive(mgr, CALM, half, **plan)
    x_mm, _, heading_rad = plain.state[:3, :, 2, 0]
    left_x, right_x = x_mm - 35 * np.sin(heading_rad), x_mm + 35 * np.sin(heading_rad)
    change = (true_displacements(slowed) - true_displacements(plain))[:, 2, 0, 2]
    only_left, only_right = (left_x > 530) & (right_x < 500), (right_x > 530) & (left_x < 500)
    assert only_left.any()
    assert only_right.any()
    assert (change[only_left] > 0.1).all()
    assert (change[only_right] < -0.1).all()


def test_walls_take_the_share_that_belongs_to_their_distance(mgr):
    wall = {"name": "wall_effect", "loss": 0.6, "reach_mm": 150}
    plan = {"runs": 40, "steps": 3, "drive": np.array([(60.0, 60.0)])}
    plain, slowed = drive(mgr, CALM, **plan), drive(mgr, CALM, wall, **plan)
    as_told = ((plain.command == 60) & (slowed.command == 60)).all(axis=(1, 2, 3))
    middle = slowed.state[:2, :, 2:4, 0].mean(axis=2)
    distance_mm = np.minimum(middle, 1030 - middle).min(axis=0)
    ratio = (true_displacements(slowed) / true_displacements(plain))[:, 2, 0, 0]
    expected = 1 - 0.6 * np.exp(-distance_mm / 150)
    assert expected[as_told].max() - expected[as_told].min() > 0.1
    np.testing.assert_allclose(ratio[as_told], expected[as_told], atol=0.03)


def test_a_carrying_floor_adds_its_velocity_whatever_the_car_does(mgr):
    drift = {"name": "steady_drift", "speed_mm_s": 6, "direction_rad": 0.7}
    plan = {"runs": 10, "steps": 4, "drive": np.random.default_rng(1).uniform(-100, 100, (40, 2))}
    plain, carried = drive(mgr, CALM, **plan), drive(mgr, CALM, drift, **plan)
    as_told = (plain.command == carried.command).all(axis=(1, 2, 3))
    added = (carried.state - plain.state)[:2, as_told, -1, 0].T
    np.testing.assert_allclose(added, [[12 * np.cos(0.7), 12 * np.sin(0.7)]] * as_told.sum(), atol=0.1)
    assert as_told.sum() > 3


def test_noise_change_multiplies_the_spread_and_leaves_the_mean(mgr):
    plain, rough = (
        held_displacements(mgr, (80.0, 80.0), *effects, runs=300, steps=2)[:, 0]
        for effects in ((), ({"name": "noise_change", "factor": 2},))
    )
    assert rough.std() / plain.std() == pytest.approx(2, rel=0.15)
    assert abs(rough.mean() - plain.mean()) < 3.3 * rough.std() / np.sqrt(len(rough))


def test_a_marker_beside_the_axle_is_found_by_least_squares_on_turns(mgr):
    """The marker moves by forward · (cos turn − 1) ahead and forward · sin turn to the left of what the axle does."""
    plan = {"runs": 40, "steps": 20}
    moved = measured_displacements(drive(mgr, {"name": "marker_offset", "forward_mm": 8, "left_mm": -5}, **plan))[
        :, :, 0
    ]
    plain = true_displacements(drive(mgr, **plan))[:, :, 0]
    turn = plain[..., 2].ravel()
    ahead = np.stack([np.cos(turn) - 1, -np.sin(turn)], axis=1)
    left = np.stack([np.sin(turn), np.cos(turn) - 1], axis=1)
    away = (moved - plain)[..., :2].reshape(-1, 2)
    design, seen = np.concatenate([ahead, left]), np.concatenate([away[:, 0], away[:, 1]])
    np.testing.assert_allclose(np.linalg.lstsq(design, seen)[0], [8, -5], atol=0.3)


def test_a_turned_marker_and_a_wrong_scale_show_in_the_pictures_alone(mgr):
    plan = {"runs": 30, "steps": 10}
    plain = drive(mgr, **plan)
    turned, scaled = (
        drive(mgr, {"name": "marker_yaw", "angle_rad": 0.12}, **plan),
        drive(mgr, {"name": "camera_scale", "scale": 1.06}, **plan),
    )
    np.testing.assert_array_equal(turned.state, plain.state)
    np.testing.assert_allclose(np.sin(turned.pose - plain.pose)[..., 2], np.sin(0.12), atol=1e-6)
    from_middle = (plain.state[:2] - 515).ravel()
    seen = np.moveaxis(scaled.pose[..., :2], -1, 0).ravel() - 515
    assert from_middle @ seen / (from_middle @ from_middle) == pytest.approx(1.06, abs=0.002)


def test_jitter_makes_periods_longer_or_shorter_and_the_way_with_them(mgr):
    driven = drive(mgr, CALM, {"name": "timing_jitter", "spread": 0.1}, runs=30, steps=3, drive=np.array([AHEAD]))
    duration_s = np.diff(driven.time_s)
    assert duration_s.std() == pytest.approx(0.05, rel=0.25)
    as_told = (driven.command[:, :, 0] == AHEAD).all(axis=(1, 2))
    speed_mm_s = true_displacements(driven)[as_told, 2, 0, 0] / duration_s[as_told, 2]
    assert speed_mm_s.std() / speed_mm_s.mean() < 0.01
