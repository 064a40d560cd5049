from dataclasses import replace

import numpy as np
import pytest

from swarmtwin.errors import UserError
from swarmtwin.geometry import displacement_between, orientation_error_rad, position_error_mm
from swarmtwin.standin.drive_commands import Operator
from swarmtwin.standin.effects import parse_effects
from swarmtwin.standin.exact_means import mean_given_situation, mean_given_state
from swarmtwin.standin.session import StandInSession, drive_session, require_stand_in

JITTER = {"name": "timing_jitter", "spread": 0.3}
STANDARD = ("command", "time_s", "pose", "state")


def displacements(driven):
    return displacement_between(driven.pose[:, :-1], driven.pose[:, 1:])


@pytest.fixture(scope="module", params=["mgr", "mur"])
def session(request, robots):
    return StandInSession(robots[request.param], ("1",), runs=12, steps=10, seed=5, lost_poses=0.05)


@pytest.fixture(scope="module")
def driven(robots):
    """A moderate session of each robot."""
    return {name: drive_session(StandInSession(robots[name], ("1",), 150, 40, 3)) for name in ("mgr", "mur")}


def test_the_same_seed_gives_the_same_bytes_and_another_seed_others(session):
    first, again, other = drive_session(session), drive_session(session), drive_session(replace(session, seed=6))
    for name in STANDARD:
        assert getattr(first, name).tobytes() == getattr(again, name).tobytes()
    for name in ("command", "pose", "state"):
        assert not np.array_equal(getattr(first, name), getattr(other, name))


def test_fewer_runs_are_the_first_of_more_runs(session):
    few, many = drive_session(replace(session, runs=5, planned_runs=12)), drive_session(session)
    for name in ("command", "time_s", "pose"):
        np.testing.assert_array_equal(getattr(few, name), getattr(many, name)[:5])


def test_runs_follow_each_other_with_a_pause(session):
    time_s = drive_session(session).time_s
    np.testing.assert_allclose(np.diff(time_s), session.robot.period_s)
    np.testing.assert_allclose(time_s[1:, 0] - time_s[:-1, -1], session.pause_s)


def test_the_camera_misses_about_as_many_markers_as_it_is_told_to(session):
    pose = drive_session(replace(session, runs=400)).pose
    missed = np.isnan(pose).any(axis=-1)
    assert np.isnan(pose[missed]).all()
    assert abs(missed.mean() - 0.05) < 4 * np.sqrt(0.05 * 0.95 / missed.size)


def test_commands_cover_their_limits_and_never_exceed_them(driven):
    for each in driven.values():
        robot, command = each.session.robot, each.command.reshape(-1, each.command.shape[-1])
        span = robot.command_high - robot.command_low
        assert (command >= robot.command_low).all()
        assert (command <= robot.command_high).all()
        assert (command.min(axis=0) < robot.command_low + 0.01 * span).all()
        assert (command.max(axis=0) > robot.command_high - 0.01 * span).all()


def test_vehicles_stay_in_the_arena(driven):
    for each in driven.values():
        arena = each.session.robot.arena_mm
        position = np.moveaxis(each.state[:2], 0, -1)
        assert (position > arena.low_mm).all()
        assert (position < arena.high_mm).all()


def test_mgr_spans_and_floors_are_the_papers(driven):
    mgr = driven["mgr"]
    moved = displacements(mgr)
    assert np.mean(np.abs(moved) > mgr.session.robot.displacement_limit) < 1e-3
    assert 40 < np.quantile(moved[..., 0], 0.999) < 50
    assert 1.0 < np.quantile(moved[..., 2], 0.999) < 1.4
    situation, everything = mean_given_situation(mgr), mean_given_state(mgr)
    assert 42 < np.abs(situation[..., 0]).max() < 44.5
    assert 3.0 < position_error_mm(situation, moved).mean() < 4.0
    assert 3.5 < np.rad2deg(orientation_error_rad(situation, moved).mean()) < 4.5
    assert 2.3 < position_error_mm(everything, moved).mean() < 2.7
    assert 2.5 < np.rad2deg(orientation_error_rad(everything, moved).mean()) < 3.0


def test_mur_spans_and_floors_are_the_papers(driven):
    mur = driven["mur"]
    moved = displacements(mur)
    assert np.mean(np.abs(moved) > mur.session.robot.displacement_limit) < 2e-3
    forward_mm, left_mm, turn_rad = moved.reshape(-1, 3).T
    assert abs(forward_mm.mean() - 31.9) < 6
    assert abs(forward_mm.std() - 32.7) < 5
    assert abs(left_mm.std() - 22.8) < 3
    assert abs(turn_rad.std() - 0.507) < 0.05
    assert -74 < np.quantile(forward_mm, 0.001) < -40
    assert 85 < np.quantile(forward_mm, 0.999) < 102
    situation = mean_given_situation(mur)
    assert 12 < position_error_mm(situation, moved).mean() < 15
    assert 6 < np.rad2deg(orientation_error_rad(situation, moved).mean()) < 8


def test_another_vehicle_is_a_few_per_cent_different(driven):
    mgr = driven["mgr"]
    own = mean_given_state(mgr)
    others = mean_given_state(replace(mgr, session=replace(mgr.session, vehicles=("2",))))
    strongest = np.abs(own[..., 0]) > 30
    deviation = np.abs(others[strongest][:, 0] / own[strongest][:, 0] - 1).mean()
    assert 0.002 < deviation < 0.06
    assert 0.2 < position_error_mm(own, others).mean() < 2


def test_gentle_commands_stay_in_the_inner_half(session):
    robot = session.robot
    command = drive_session(replace(session, command_mode="gentle")).command
    quarter = (robot.command_high - robot.command_low) / 4
    assert (command >= robot.command_low + quarter - 0.05).all()
    assert (command <= robot.command_high - quarter + 0.05).all()


def test_held_commands_are_held_where_there_is_nothing_to_avoid(session):
    command = drive_session(replace(session, command_mode="held", runs=50)).command[:, :8, 0]
    repeated = (np.diff(command, axis=1) == 0).all(axis=-1)
    assert not repeated[:, Operator.held_periods - 1].any()
    assert np.delete(repeated, Operator.held_periods - 1, axis=1).mean() > 0.5


def test_waypoints_bring_the_vehicle_further_than_chance(robots):
    session = StandInSession(robots["mgr"], ("1",), 60, 12, 5)

    def travelled_mm(command_mode):
        state = drive_session(replace(session, command_mode=command_mode)).state
        return np.hypot(*(state[:2, :, -1, 0] - state[:2, :, 0, 0])).mean()

    assert travelled_mm("waypoints") > 2 * travelled_mm("uniform")


def test_a_drive_is_played_run_after_run_and_from_its_beginning_again(session):
    robot = session.robot
    drive = np.linspace(robot.command_low, (robot.command_low + robot.command_high) / 2, 35)
    driven = drive_session(replace(session, drive=drive, runs=7))
    played = driven.command.reshape(70, -1)
    as_written = (played == np.concatenate([drive, drive])).all(axis=1)
    assert as_written.mean() > 0.5
    position = np.moveaxis(driven.state[:2, :, :-1, 0], 0, -1).reshape(70, 2)
    inner = ((position > robot.arena_mm.low_mm + 170) & (position < robot.arena_mm.high_mm - 170)).all(axis=1)
    assert as_written[inner].all()


def test_several_vehicles_start_apart_and_share_the_clock(robots):
    driven = drive_session(StandInSession(robots["mgr"], ("1", "2", "3"), 40, 3, 5))
    start = driven.state[:2, :, 0]
    for one, other in ((0, 1), (0, 2), (1, 2)):
        assert np.hypot(*(start[:, :, one] - start[:, :, other])).min() > 100
    assert driven.pose.shape == (40, 4, 3, 3)


def test_a_robot_without_a_stand_in_is_refused(robots):
    with pytest.raises(UserError, match="robot 'create' has no stand-in: known: mgr, mur"):
        require_stand_in(robots["create"])


def test_a_robot_that_only_borrows_the_name_of_a_stand_in_is_refused(robots):
    with pytest.raises(UserError) as refused:
        require_stand_in(robots["mgr"].model_copy(update={"name": "mur"}))
    assert str(refused.value) == (
        "the stand-in of robot 'mur' is driven by mean_angle_deg, amplitude_deg, frequency_rad_s, not by left, right: "
        "use conf/robot/mur.yaml, robot=mur"
    )


def test_a_run_begins_after_the_former_one_has_ended_however_long_its_periods_were(robots):
    robot = robots["mgr"]
    session = StandInSession(robot, ("1",), 40, 600, 3, effects=parse_effects([JITTER], robot, 1))
    time_s = drive_session(session).time_s
    late = time_s[:-1, -1] > np.arange(1, 40) * session.run_length_s
    assert late.any()
    assert not late.all()
    pause_s = time_s[1:, 0] - time_s[:-1, -1]
    assert pause_s.min() >= robot.period_s * (1 - 1e-9)
    np.testing.assert_array_equal(drive_session(replace(session, runs=9, planned_runs=40)).time_s, time_s[:9])
