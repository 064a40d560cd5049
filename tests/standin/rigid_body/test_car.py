"""The car's own physics: what it does without effects, and that its numbers do not hang on the time step."""

import sys
from dataclasses import replace

import numpy as np
import pytest
from rigid_drives import CALM, drive, held_displacements, steady_displacement, true_displacements

from swarmtwin.errors import UserError
from swarmtwin.standin.effects import parse_effects
from swarmtwin.standin.rigid_body.car import Car
from swarmtwin.standin.rigid_body.driving import drive_rigid_session
from swarmtwin.standin.session import StandInSession
from swarmtwin.studies.stand_in_recording import record
from swarmtwin.transitions import from_recording


@pytest.fixture(scope="module")
def session(robots):
    return StandInSession(robots["mgr"], ("1",), runs=8, steps=8, seed=5, lost_poses=0.05)


def test_the_same_seed_gives_the_same_bytes_and_another_seed_others(session):
    first, again, other = (drive_rigid_session(each) for each in (session, session, replace(session, seed=6)))
    for name in ("command", "time_s", "pose", "state"):
        assert getattr(first, name).tobytes() == getattr(again, name).tobytes()
    assert not np.array_equal(first.command, other.command)
    assert not np.array_equal(first.state, other.state)


def test_fewer_runs_are_the_first_of_more_runs(session):
    few, many = drive_rigid_session(replace(session, runs=3, planned_runs=8)), drive_rigid_session(session)
    for name in ("command", "time_s", "pose"):
        np.testing.assert_array_equal(getattr(few, name), getattr(many, name)[:3])


def test_a_unit_is_the_same_whoever_else_drives_and_units_differ(robots):
    """Two units that get the same commands differ by a few per cent, as fabrication does."""
    command = (90.0, 90.0)
    alone = steady_displacement(robots["mgr"], command)
    both = drive(robots["mgr"], CALM, vehicles=("1", "2"), runs=2, steps=3, drive=np.array([command]))
    moved = true_displacements(both)[:, 2]
    np.testing.assert_allclose(moved[0, 0], alone, atol=0.02)
    units = np.array([steady_displacement(robots["mgr"], command, vehicles=(str(unit),))[0] for unit in range(1, 9)])
    assert 0.005 < units.std() / units.mean() < 0.04


def test_clean_drives_make_a_recording_nearly_all_of_which_is_usable(robots):
    _, recording = record(StandInSession(robots["mgr"], ("1",), 20, 40, 7, lost_poses=0.001), drive=drive_rigid_session)
    _, counts = from_recording(recording)
    assert counts.kept > 0.98 * 20 * 40
    assert set(counts.dropped) <= {"no_pose"}


def test_full_speed_is_a_sisters_of_the_robot_and_small_commands_do_not_overcome_friction(robots):
    full = steady_displacement(robots["mgr"], (120.0, 120.0))
    assert 40 < full[0] < 50
    assert abs(steady_displacement(robots["mgr"], (7.0, 7.0))[0]) < 0.2
    assert steady_displacement(robots["mgr"], (20.0, 20.0))[0] > 1
    turning = steady_displacement(robots["mgr"], (-120.0, 120.0))
    assert turning[2] == pytest.approx(2 * full[0] / 70, rel=0.06)


def test_a_car_on_the_move_rolls_on_when_told_to_stop_and_then_stands(robots):
    driven = drive(robots["mgr"], CALM, runs=1, steps=4, drive=np.array([[90, 90], [90, 90], [0, 0], [0, 0]], float))
    moved = true_displacements(driven)[0, :, 0, 0]
    assert moved[1] / 0.5 * 0.01 < moved[2] < moved[1] / 0.5 * 0.06  # it rolls on for 10 to 60 ms of its speed
    assert abs(moved[3]) < 0.02


PLAY, BAD_FLOOR = {"name": "backlash", "travel_mm": 4.0}, {"name": "surface_patch", "radius_mm": 3000.0, "loss": 0.4}


@pytest.mark.parametrize("effects", [(), (PLAY,), (BAD_FLOOR,), (PLAY, BAD_FLOOR)])
def test_a_time_step_four_times_shorter_gives_nearly_the_same_motion(robots, monkeypatch, effects):
    plan = {"runs": 10, "steps": 5, "drive": np.random.default_rng(2).uniform(-120, 120, (50, 2))}
    usual = drive(robots["mgr"], *effects, **plan)
    monkeypatch.setattr(Car, "steps", 400)
    fine = drive(robots["mgr"], *effects, **plan)
    away = true_displacements(usual)[:, 0] - true_displacements(fine)[:, 0]
    assert np.abs(away[..., :2]).max() < 0.4
    assert np.abs(away[..., 2]).max() < 0.012


def test_chance_is_in_proportion_to_speed_and_without_bias(robots):
    forward = held_displacements(robots["mgr"], (80.0, 80.0), runs=200, steps=2)[:, 0]
    calm = held_displacements(robots["mgr"], (80.0, 80.0), CALM, steps=2)[:, 0].mean()
    assert 0.03 < forward.std() / calm < 0.08
    assert abs(forward.mean() - calm) < 3.3 * forward.std() / np.sqrt(len(forward))


def test_the_cameras_errors_have_heavier_tails_than_a_normal_distribution(robots):
    driven = drive(robots["mgr"], runs=300, steps=4, drive=np.zeros((1, 2)))
    error = (driven.pose - np.moveaxis(driven.state[:3], 0, -1))[..., 0].ravel()
    kurtosis = np.mean(error**4) / np.mean(error**2) ** 2
    assert 0.8 < error.std() < 1.2
    assert 4 < kurtosis < 9


def test_what_is_no_force_on_a_body_and_robots_without_a_body_are_refused(robots):
    pushed = parse_effects([{"name": "neighbour_interaction"}], robots["mgr"], 2)
    with pytest.raises(UserError, match=r"'NeighbourInteraction'.*no force on a rigid body.*engine=formulas"):
        drive_rigid_session(StandInSession(robots["mgr"], ("1", "2"), 1, 1, 1, pushed))
    with pytest.raises(UserError, match="robot 'create' has no rigid body"):
        drive_rigid_session(StandInSession(robots["create"], ("1",), 1, 1, 1))


def test_without_the_engine_it_says_what_to_install(robots, monkeypatch):
    monkeypatch.setitem(sys.modules, "mujoco", None)
    with pytest.raises(UserError, match=r"needs MuJoCo.*pip install 'mujoco>=4\.0\.0,<5'.*engine=formulas"):
        drive(robots["mgr"], runs=1, steps=1)
