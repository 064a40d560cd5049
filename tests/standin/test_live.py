"""Vehicles driven live move as those that were recorded: the same physics, the same camera."""

import numpy as np
import pytest

from swarmtwin.errors import UserError
from swarmtwin.geometry import displacement_between
from swarmtwin.standin.effects import parse_effects
from swarmtwin.standin.live import LiveVehicles
from swarmtwin.standin.session import StandInSession, drive_session

RUNS, STEPS = 300, 12


def drive(live, start, commands):
    """Poses (R, T + 1, V, 3) of live vehicles that follow commands (R, T, V, m)."""
    poses = [live.place(np.arange(len(start)), start)]
    poses += [live.move(commands[:, step]) for step in range(commands.shape[1])]
    return np.stack(poses, axis=1)


@pytest.mark.parametrize("robot", ["mgr", "mur"])
@pytest.mark.parametrize(
    "effects",
    [
        [],
        [{"name": "command_delay", "delay_s": 0.2}, {"name": "command_loss", "probability": 0.2}],
        [{"name": "noise_change", "factor": 2.0}, {"name": "marker_yaw", "angle_rad": 0.2}],
    ],
    ids=["clean", "late and lost", "noisy, marker turned"],
)
def test_live_vehicles_move_as_recorded_ones(robots, robot, effects):
    effects = parse_effects(effects, robots[robot], 2)
    drive_to_play = np.random.default_rng(0).uniform(
        robots[robot].command_low, robots[robot].command_high, (STEPS, len(robots[robot].command))
    )
    vehicles = ("2", "5")
    session = StandInSession(robots[robot], vehicles, RUNS, STEPS, 1, effects, drive=drive_to_play, planned_runs=RUNS)
    driven = drive_session(session)
    true_start = np.moveaxis(driven.state[:3, :, 0], 0, -1)
    live = LiveVehicles(robots[robot], vehicles, RUNS, 2, effects, planned_steps=STEPS)
    poses = drive(live, true_start, driven.command)
    moved = displacement_between(poses[:, :-1], poses[:, 1:])
    recorded = displacement_between(driven.pose[:, :-1], driven.pose[:, 1:])
    standard_error = np.sqrt((moved.var(axis=0) + recorded.var(axis=0)) / RUNS)
    deviation = (moved.mean(axis=0) - recorded.mean(axis=0)) / standard_error
    assert np.abs(deviation).max() < 4.5
    assert (deviation**2).mean() < 1.6
    spread = moved.std(axis=0) / recorded.std(axis=0)
    assert np.median(np.abs(spread - 1)) < 0.1


def test_a_battery_that_sags_slows_a_live_vehicle_down_until_the_plan_ends(robots):
    effects = parse_effects([{"name": "battery_sag", "loss": 0.5}], robots["mgr"], 1)
    live = LiveVehicles(robots["mgr"], ("1",), 50, 3, effects, planned_steps=20)
    ahead = np.full((50, 30, 1, 2), 100.0)
    poses = drive(live, np.zeros((50, 1, 3)), ahead)
    forward_mm = displacement_between(poses[:, :-1], poses[:, 1:])[..., 0].mean(axis=(0, 2))
    assert forward_mm[18:].mean() < 0.65 * forward_mm[1:3].mean()
    assert abs(forward_mm[21:25].mean() / forward_mm[25:].mean() - 1) < 0.03


def test_the_same_seed_gives_the_same_poses_and_another_seed_others(robots):
    commands = np.full((4, 5, 2, 2), 80.0)
    start = np.zeros((4, 2, 3))
    first, again, other = (
        drive(LiveVehicles(robots["mgr"], ("1", "2"), 4, seed), start, commands) for seed in (1, 1, 2)
    )
    np.testing.assert_array_equal(first, again)
    assert not np.array_equal(first, other)


def test_a_vehicle_that_is_placed_anew_forgets_its_past(robots):
    live = LiveVehicles(robots["mgr"], ("1",), 200, 4)
    live.place(np.arange(200), np.zeros((200, 1, 3)))
    for _ in range(3):
        live.move(np.full((200, 1, 2), 120.0))
    measured = live.place(np.arange(100), np.full((100, 1, 3), 1.0))
    assert np.abs(measured - 1.0).max() < 6.0
    standing = live.move(np.zeros((200, 1, 2)))
    assert np.abs(standing[:100, :, :2] - 1.0).max() < 6.0
    assert np.linalg.norm(standing[100:, :, :2], axis=-1).min() > 50.0


def test_a_robot_without_a_stand_in_is_refused(robots):
    with pytest.raises(UserError, match="robot 'create' has no stand-in"):
        LiveVehicles(robots["create"], ("1",), 1, 0)


@pytest.mark.parametrize("robot", ["mgr", "mur"])
def test_one_group_goes_through_the_very_numbers_of_a_recorded_run(robots, robot):
    effects = parse_effects([{"name": "command_loss", "probability": 0.3}], robots[robot], 2)
    driven = drive_session(StandInSession(robots[robot], ("2", "5"), 1, STEPS, 7, effects))
    live = LiveVehicles(robots[robot], ("2", "5"), 1, 7, effects)
    poses = drive(live, np.moveaxis(driven.state[:3, :, 0], 0, -1), driven.command)
    np.testing.assert_allclose(poses, driven.pose, rtol=0, atol=1e-9)


def test_a_vehicle_that_is_named_twice_is_refused(robots):
    with pytest.raises(UserError, match="vehicle '2' is named twice: give each id once"):
        LiveVehicles(robots["mgr"], ("2", "3", "2"), 1, 0)
