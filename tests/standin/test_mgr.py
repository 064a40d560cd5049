import numpy as np
import pytest

from swarmtwin.geometry import displacement_between
from swarmtwin.standin.active_effects import ActiveEffects
from swarmtwin.standin.physics import Period, advance
from swarmtwin.standin.robots.mgr import MgrUnit, StandIn

COMMANDS = np.random.default_rng(4).uniform(-120, 120, (2, 60, 1))
REST = np.zeros((2, 60, 1))
START = np.random.default_rng(5).uniform((200, 200, -3), (800, 800, 3), (60, 3)).T[:, :, None]


def move(physics, start, commands):
    """Return displacements (N, 3) of vehicles that start at rest at poses (3, N, 1)."""
    state = physics.at_rest(start)
    for command, previous in zip(commands, [REST, *commands[:-1]], strict=True):
        state = advance(physics, state, Period(command, previous, 0.5, 0.0))
    return displacement_between(np.moveaxis(start, 0, -1), np.moveaxis(state[:3], 0, -1))[:, 0]


@pytest.fixture
def drawn(robots):
    return StandIn(MgrUnit.as_drawn(), ActiveEffects(robots["mgr"]))


def test_equal_wheels_drive_a_symmetric_vehicle_straight(drawn):
    moved = move(drawn, START, [np.broadcast_to(COMMANDS[:1], COMMANDS.shape)])
    np.testing.assert_allclose(moved[:, 1:], 0, atol=1e-9)
    driving = np.abs(COMMANDS[0, :, 0]) > 20
    assert (np.sign(moved[driving, 0]) == np.sign(COMMANDS[0, driving, 0])).all()


def test_a_faster_right_wheel_turns_left(drawn):
    commands = np.stack([np.full((1, 1), 30.0), np.full((1, 1), 90.0)])
    moved = move(drawn, START[:, :1], [commands])
    assert moved[0, 0] > 0
    assert moved[0, 2] > 0
    assert moved[0, 1] > 0


def test_wheels_exchanged_mirror_the_motion(drawn):
    moved = move(drawn, START, [COMMANDS])
    mirrored = move(drawn, START, [COMMANDS[::-1]])
    np.testing.assert_allclose(mirrored, moved * [1, -1, -1], atol=1e-9)


def test_motion_in_the_vehicles_frame_does_not_depend_on_the_pose(drawn):
    elsewhere = START + np.array([130.0, -70.0, 1.9]).reshape(3, 1, 1)
    np.testing.assert_allclose(move(drawn, START, [COMMANDS]), move(drawn, elsewhere, [COMMANDS]), atol=1e-9)


def test_commands_inside_the_dead_band_do_nothing(drawn):
    np.testing.assert_allclose(move(drawn, START, [COMMANDS / 120 * 11.9]), 0, atol=1e-9)


def test_a_moving_vehicle_rolls_on_when_told_to_stop(drawn):
    ahead = np.full_like(COMMANDS, 100.0)
    through_stop = move(drawn, START, [ahead, REST])[:, 0] - move(drawn, START, [ahead])[:, 0]
    lag_s, speed_mm_s = 0.055, drawn.target(ahead, 1.0)[0, 0] * (1 - drawn.slip)
    np.testing.assert_allclose(through_stop, (lag_s * speed_mm_s)[0], rtol=1e-3)


def test_the_time_step_converges_with_second_order(drawn, monkeypatch):
    def end_of_two_periods(substeps):
        monkeypatch.setattr(StandIn, "substeps", substeps)
        return move(drawn, START, [COMMANDS, -COMMANDS[::-1]])

    exact = end_of_two_periods(800)
    steps = np.array([10, 20, 40, 80])
    error = [np.abs(end_of_two_periods(count) - exact).max() for count in steps]
    order = -np.polyfit(np.log(steps), np.log(error), 1)[0]
    assert 1.9 < order < 2.1
    assert np.abs(end_of_two_periods(25) - exact).max() < 0.02
