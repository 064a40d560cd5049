"""Vehicles of the engine that are driven live move as those that were recorded in it."""

import numpy as np
import pytest

from swarmtwin.errors import UserError
from swarmtwin.standin.effects import parse_effects
from swarmtwin.standin.rigid_body.driving import drive_rigid_session
from swarmtwin.standin.rigid_body.live import LiveRigidVehicles
from swarmtwin.standin.session import StandInSession

pytest.importorskip("mujoco")
STEPS = 6


def drive(live, start, commands):
    """Poses (R, T + 1, V, 3) of live vehicles that follow commands (R, T, V, m)."""
    poses = [live.place(np.arange(len(start)), start)]
    poses += [live.move(commands[:, step]) for step in range(commands.shape[1])]
    return np.stack(poses, axis=1)


@pytest.mark.parametrize("robot", ["mgr", "mur"])
def test_one_group_moves_as_a_recorded_run_with_the_same_chances(robots, robot):
    effects = parse_effects([{"name": "command_loss", "probability": 0.3}], robots[robot], 2)
    driven = drive_rigid_session(StandInSession(robots[robot], ("2", "5"), 1, STEPS, 7, effects))
    live = LiveRigidVehicles(robots[robot], ("2", "5"), 1, 7, effects)
    poses = drive(live, np.moveaxis(driven.state[:3, :, 0], 0, -1), driven.command)
    # the camera's random numbers come in another order; its noise is what may differ
    assert np.abs(poses - driven.pose)[..., :2].max() < 25.0
    moved = np.linalg.norm(poses[:, -1, :, :2] - poses[:, 0, :, :2], axis=-1)
    assert moved.min() > 10.0
    np.testing.assert_allclose(
        np.moveaxis(live._state[:3], 0, -1), np.moveaxis(driven.state[:3, :, -1], 0, -1), atol=1e-6
    )


@pytest.mark.parametrize("robot", ["mgr", "mur"])
def test_groups_that_are_put_back_begin_anew_and_the_others_go_on(robots, robot):
    rng = np.random.default_rng(0)
    commands = rng.uniform(
        robots[robot].command_low, robots[robot].command_high, (4, STEPS, 2, len(robots[robot].command))
    )
    start = np.zeros((4, 2, 3))
    fresh, used = (LiveRigidVehicles(robots[robot], ("2", "3"), 4, 3) for _ in range(2))
    drive(used, start, commands)
    before = used._state.copy()
    used.place(np.array([1, 3]), start[:2] + 5.0)
    fresh.place(np.arange(4), start + 5.0)
    np.testing.assert_array_equal(used._state[:, [0, 2]], before[:, [0, 2]])
    np.testing.assert_allclose(used._state[:, [1, 3]], fresh._state[:, [1, 3]], atol=1e-12)


def test_an_effect_that_the_engine_cannot_have_is_refused(robots):
    effects = parse_effects([{"name": "neighbour_interaction"}], robots["mgr"], 2)
    with pytest.raises(UserError, match="use engine=formulas"):
        LiveRigidVehicles(robots["mgr"], ("2", "3"), 1, 3, effects)
