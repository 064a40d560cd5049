"""Effects of ground, neighbours, link and clock, and of the noise."""

import numpy as np
from pairs import displacements, session, true_displacements

from swarmtwin.standin.effect import Placement
from swarmtwin.standin.effects import parse_effects
from swarmtwin.standin.exact_means import mean_given_state
from swarmtwin.standin.session import drive_session


def test_a_surface_patch_is_felt_inside_and_nowhere_else(robots):
    robot = robots["mgr"]
    entry = {"name": "surface_patch", "x_mm": 500, "y_mm": 600, "radius_mm": 250, "loss": 0.5}
    plain, changed = (drive_session(session(robot, *entries, runs=500, steps=1)) for entries in ((), (entry,)))
    from_centre = np.hypot(plain.state[0, :, 0] - 500, plain.state[1, :, 0] - 600)
    before, after = true_displacements(plain)[:, 0], true_displacements(changed)[:, 0]
    outside, inside = from_centre > 310, from_centre < 190
    np.testing.assert_array_equal(before[outside], after[outside])
    np.testing.assert_allclose(after[inside][:, 2], 0.5 * before[inside][:, 2], atol=1e-9)


def test_a_steady_drift_carries_resting_vehicles_along_its_direction(robots):
    robot = robots["mgr"]
    entry = {"name": "steady_drift", "speed_mm_s": 10, "direction_rad": 2.0}
    driven = drive_session(session(robot, entry, runs=50, steps=1, drive=np.zeros((1, 2))))
    moved = np.diff(driven.state[:2], axis=2)
    np.testing.assert_allclose(moved[0], 5 * np.cos(2.0), atol=1e-9)
    np.testing.assert_allclose(moved[1], 5 * np.sin(2.0), atol=1e-9)
    np.testing.assert_allclose(np.diff(driven.state[2], axis=1), 0, atol=1e-9)


def test_the_wall_effect_weakens_with_nearness(robots):
    effect = parse_effects([{"name": "wall_effect", "loss": 0.5, "reach_mm": 100}], robots["mgr"], 1)[0]
    x_mm = np.array([0.0, 100.0, 515.0, 930.0, 1030.0])
    placement = Placement(x_mm, x_mm, np.full(5, 515.0), x_mm, x_mm, x_mm)
    expected = 1 - 0.5 * np.exp(-np.array([0, 100, 515, 100, 0]) / 100)
    np.testing.assert_allclose(effect.traction(placement, robots["mgr"].arena_mm), expected)


def test_neighbours_push_each_other_apart_and_the_more_the_nearer(robots):
    robot = robots["mgr"]
    entry = {"name": "neighbour_interaction", "strength_mm_s": 40, "reach_mm": 200}
    still = np.zeros((1, 2))
    three = drive_session(session(robot, entry, runs=60, steps=1, drive=still, vehicles=("1", "2", "3"))).state[:2]
    np.testing.assert_allclose(three.sum(axis=-1)[:, :, 0], three.sum(axis=-1)[:, :, 1], atol=1e-6)
    pair = drive_session(session(robot, entry, runs=60, steps=1, drive=still)).state[:2]
    distance = np.hypot(*(pair[..., 0] - pair[..., 1]))
    gained = distance[:, 1] - distance[:, 0]
    assert (gained > 0).all()
    assert (np.diff(gained[np.argsort(distance[:, 0])]) < 0).all()


def test_the_mean_knows_the_neighbours(robots):
    robot = robots["mgr"]
    entry = {"name": "neighbour_interaction", "strength_mm_s": 60, "reach_mm": 400}
    driven = drive_session(session(robot, entry, runs=60, steps=10, vehicles=("1", "2", "3")))
    measured = displacements(driven)
    off = measured - mean_given_state(driven)
    count = off[..., 0].size
    assert (np.abs(off.mean(axis=(0, 1, 2)) / off.std(axis=(0, 1, 2)) * np.sqrt(count)) < 3.5).all()
    assert off[..., 0].std() < 2.6


def test_lost_commands_let_the_one_before_go_on_as_often_as_stated(robots):
    driven = drive_session(
        session(robots["mgr"], {"name": "command_loss", "probability": 0.2}, runs=300, vehicles=("1",))
    )
    sent, held = np.moveaxis(driven.command, -1, 0), driven.active_command[:, :, 1:]
    lost = (sent != held).any(axis=0)
    np.testing.assert_array_equal(held[:, lost], driven.active_command[:, :, :-1][:, lost])
    assert abs(lost.mean() - 0.2) < 3.5 * np.sqrt(0.2 * 0.8 / lost.size)


def test_timing_jitter_shows_in_the_recorded_times_and_the_motion_goes_with_them(robots):
    drive = np.array([[80.0, 80.0]])
    driven = drive_session(
        session(robots["mgr"], {"name": "timing_jitter", "spread": 0.1}, runs=300, steps=4, drive=drive)
    )
    duration_s = np.diff(driven.time_s)
    assert abs(duration_s.std() / 0.5 - 0.1) < 0.005
    assert abs(duration_s.mean() - 0.5) < 3.5 * 0.05 / np.sqrt(duration_s.size)
    kept = (driven.command == 80).all(axis=(1, 2, 3))
    moving = mean_given_state(driven)[kept][:, 2:, 0, 0]
    speed = moving / duration_s[kept][:, 2:]
    assert speed.std() < 0.004 * speed.mean()


def test_noise_change_leaves_the_mean_and_changes_the_spread(robots):
    robot = robots["mgr"]
    plain, changed = (
        drive_session(session(robot, *entries, runs=150)) for entries in ((), ({"name": "noise_change", "factor": 2},))
    )

    def scatter(driven):
        return true_displacements(driven) - mean_given_state(driven)

    assert abs(scatter(changed)[..., 2].std() / scatter(plain)[..., 2].std() - 2) < 0.05
    off = scatter(changed).mean(axis=(0, 1, 2)) / scatter(changed).std(axis=(0, 1, 2)) * np.sqrt(150 * 20 * 2)
    assert (np.abs(off) < 3.5).all()
