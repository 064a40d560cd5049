"""Open loop over seconds: each error is that of a roll-out by hand, and runs that are too short are left out."""

from dataclasses import replace

import numpy as np
import pytest
from diagnosis_factories import CommandedMotion, made_robot, simulated

from drives import header_of
from swarmtwin.diagnosis.gains import Errors, gains
from swarmtwin.diagnosis.open_loop_pieces import pieces_over, window_errors
from swarmtwin.geometry import compose
from swarmtwin.recordings.recording import Recording, Track
from swarmtwin.simulation.conditions import SessionConditions
from swarmtwin.simulation.mechanisms import camera_scale, neighbour_interaction
from swarmtwin.simulation.open_loop import open_loop
from swarmtwin.simulation.simulation import Simulation
from swarmtwin.transitions import from_recording

PERIOD_S, SCALE = 0.5, 0.8


class VelocityGiven(CommandedMotion):
    """The same simulation, which is given the velocity as well: its predictions begin with a measured displacement."""

    inputs = ("command", "velocity")


def driven(steps=40, runs=12, scale=SCALE, seed=1, period_s=PERIOD_S):
    """Runs of a robot that goes `scale` times as far ahead as is simulated, and little noise of the camera."""
    rng, tracks = np.random.default_rng(seed), []
    for run in range(runs):
        speed = rng.uniform(40, 90)  # runs differ more than what is in them
        command = rng.uniform([speed, -15], [speed + 10, 15], (steps + 1, 2))
        pose = [np.array([500.0, 400.0, rng.uniform(-3, 3)])]
        for row in range(steps):
            pose.append(compose(pose[-1], simulated(command[row]) * [scale, scale, 1.0]))
        noise = rng.normal(0, [0.3, 0.3, 0.002], (steps + 1, 3))
        time_s = run * 1000.0 + np.arange(steps + 1) * period_s
        tracks.append(Track(f"run_{run:03d}", "1", time_s, command, np.array(pose) + noise))
    return tracks


def off_mm(track, begin, rows, scale=1.0):
    """Root mean square distance of a roll-out by hand from measured positions: it goes `scale` times as far."""
    (x_mm, y_mm, heading_rad), squared = track.pose[begin], []
    for row in range(begin, begin + rows):
        ahead_mm, _, turn_rad = simulated(track.command[row]) * [scale, 1.0, 1.0]
        x_mm, y_mm = x_mm + ahead_mm * np.cos(heading_rad), y_mm + ahead_mm * np.sin(heading_rad)
        heading_rad += turn_rad
        squared.append(((track.pose[row + 1, :2] - [x_mm, y_mm]) ** 2).sum())
    return np.sqrt(np.nanmean(squared))


def by_hand(tracks, window_s, scale=1.0):
    rows = round(window_s / PERIOD_S)
    return [off_mm(track, begin, rows, scale) for track in tracks for begin in range(0, len(track) - rows, rows)]


@pytest.mark.parametrize(("window_s", "in_a_run"), [(2.0, 10), (5.0, 4), (10.0, 2), (15.0, 1), (20.0, 1)])
def test_each_error_is_that_of_a_roll_out_by_hand(window_s, in_a_run):
    tracks = driven()
    (errors,) = window_errors(Simulation(CommandedMotion(made_robot())), tracks, [window_s])
    assert errors.window_s == window_s
    assert errors.run == tuple(track.run for track in tracks for _ in range(in_a_run))
    np.testing.assert_allclose(errors.rmse_mm, by_hand(tracks, window_s), atol=1e-6)


def test_the_gain_of_a_known_cause_is_that_of_roll_outs_by_hand_over_each_window_that_runs_hold():
    """The camera shows less than was driven; the extended simulation knows how much less."""
    robot, tracks = made_robot(), driven()
    conditions = SessionConditions(arena_mm=robot.arena_mm, session_s=12000.0)
    transitions = from_recording(Recording(robot, header_of(robot, ("1",)), tuple(tracks)))[0]
    known = (camera_scale.Config(scale=SCALE),)
    before, after = (
        Errors.of(
            Simulation(CommandedMotion(robot), mechanisms, conditions), transitions, tracks, (2.0, 5.0, 10.0, 30.0)
        )
        for mechanisms in ((), known)
    )
    found = gains(before, after, transitions.run, 1000, np.random.default_rng(1)).open_loop_windows
    assert [one.window_s for one in found] == [2.0, 5.0, 10.0]  # runs last 20 s
    for one, in_a_run in zip(found, (10, 4, 2), strict=True):
        hand = [np.array(by_hand(tracks, one.window_s, scale)) for scale in (1.0, SCALE)]
        assert (one.pieces, one.runs) == (12 * in_a_run, 12)
        means, spreads = zip(*((part.mean(), part.std()) for part in hand), strict=True)
        np.testing.assert_allclose((one.before, one.after), means, rtol=1e-5)
        np.testing.assert_allclose((one.before_sd, one.after_sd), spreads, rtol=1e-4)
        by_run = (hand[0] - hand[1]).reshape(12, in_a_run).mean(axis=1)
        half = 1.96 * by_run.std() / np.sqrt(12)
        np.testing.assert_allclose((one.low, one.high), by_run.mean() + half * np.array([-1, 1]), atol=0.3 * half)
    assert found[0].low < found[2].low  # it grows


def test_a_window_of_one_long_run_alone_is_left_out():
    tracks = [*driven(), *driven(steps=60, runs=1, seed=2)]
    tracks[-1] = replace(tracks[-1], run="long")
    transitions = from_recording(Recording(made_robot(), header_of(made_robot(), ("1",)), tuple(tracks)))[0]
    errors = Errors.of(Simulation(CommandedMotion(made_robot())), transitions, tracks, (10.0, 30.0))
    assert [set(one.run) for one in errors.windows][1] == {"long"}
    found = gains(errors, errors, transitions.run, 100, np.random.default_rng(1)).open_loop_windows
    assert [(one.window_s, one.runs, one.before == one.after, one.low, one.high) for one in found] == [
        (10.0, 13, True, 0.0, 0.0)
    ]


def test_pieces_begin_at_known_poses():
    (track,) = driven(runs=1)
    pose = track.pose.copy()
    pose[[0, 9, 12]] = np.nan  # the first piece begins at row 1, the fourth at row 13
    damaged = replace(track, pose=pose)
    (errors,) = window_errors(Simulation(CommandedMotion(made_robot())), [damaged], [2.0])
    begins = [1, 4, 8, 13, *range(16, 40, 4)]
    before = [int(np.searchsorted(track.time_s, piece.time_s[0])) for piece in pieces_over(damaged, 2.0)]
    assert before == [begin - 1 for begin in begins]  # for the command before the pose
    np.testing.assert_allclose(errors.rmse_mm, [off_mm(damaged, begin, 4) for begin in begins], atol=1e-6)


def test_beyond_a_gap_nothing_is_said():
    """A command is missing: what the robot did then, nobody simulates."""
    (track,) = driven(runs=1)
    command = track.command.copy()
    command[10] = np.nan
    (errors,) = window_errors(Simulation(CommandedMotion(made_robot())), [replace(track, command=command)], [5.0])
    assert np.isfinite(errors.rmse_mm).tolist() == [True, False, True, True]


def test_a_window_ends_at_the_last_row_within_it():
    """Of a robot with a period of 0.8 s there is no row after 2 s."""
    tracks = driven(period_s=0.8)
    robot = made_robot().model_copy(update={"period_s": 0.8, "longest_gap_s": 1.0})
    (errors,) = window_errors(Simulation(CommandedMotion(robot)), tracks, [2.0])
    begins = [0, 3, 5, 8, 10, 13, 15, 18, 20, 23, 25, 28, 30, 33, 35]  # at 0, 2.4, 4.0, 6.4 s, …
    expected = [off_mm(track, begin, 2) for track in tracks for begin in begins]
    np.testing.assert_allclose(errors.rmse_mm, expected, atol=1e-6)


def test_jitter_of_the_clock_ends_no_piece_early():
    rng, tracks = np.random.default_rng(3), driven(runs=30)
    late = [track.time_s + np.r_[0, rng.uniform(-0.04, 0.04, len(track) - 1)] for track in tracks]
    jittered = [replace(track, time_s=time_s) for track, time_s in zip(tracks, late, strict=True)]
    robot = made_robot().model_copy(update={"longest_gap_s": 0.7})
    (errors,) = window_errors(Simulation(CommandedMotion(robot)), jittered, [5.0])
    assert np.isfinite(errors.rmse_mm).all()
    assert len(errors.rmse_mm) >= 3 * 30
    assert errors.rmse_mm.mean() == pytest.approx(np.mean(by_hand(tracks, 5.0)), rel=0.05)


def test_a_simulation_that_looks_at_velocity_is_given_the_first_displacement():
    tracks = driven(runs=3)
    (errors,) = window_errors(Simulation(VelocityGiven(made_robot())), tracks, [2.0])
    expected = [off_mm(track, begin + 1, 3) for track in tracks for begin in range(0, 40, 4)]
    np.testing.assert_allclose(errors.rmse_mm, expected, atol=1e-6)


def test_vehicles_of_one_run_push_each_other_in_its_pieces():
    """A window as long as the runs predicts what whole runs do, and another than vehicles that are alone."""
    (one,), (other,) = driven(runs=1), driven(runs=1, seed=4)
    pair = [one, replace(other, vehicle="2", pose=other.pose + np.array([60.0, 0.0, 0.0]))]
    robot = made_robot()
    conditions = SessionConditions(arena_mm=robot.arena_mm, session_s=20.0)
    pushing = neighbour_interaction.Config(strength_mm_s=20.0, reach_mm=300.0)
    simulation = Simulation(CommandedMotion(robot), [pushing], conditions)
    (errors,) = window_errors(simulation, pair, [20.0])
    whole = [loop.rmse_mm for loop in open_loop(simulation, pair)]
    np.testing.assert_allclose(errors.rmse_mm, whole, atol=1e-6)
    names = [[piece.run for piece in pieces_over(track, 5.0)] for track in pair]
    assert names[0] == names[1]  # those of one time are one run
    assert len(set(names[0])) == 4
    alone = [window_errors(simulation, [track], [20.0])[0].rmse_mm[0] for track in pair]
    assert np.abs(errors.rmse_mm - alone).min() > 1


@pytest.mark.parametrize("window_s", [1e-5, 0.3])
def test_a_window_within_a_period_shows_nothing(window_s):
    (track,) = driven(runs=1)
    assert len(list(pieces_over(track, window_s))) == 40
    assert np.isnan(window_errors(Simulation(CommandedMotion(made_robot())), [track], [window_s])[0].rmse_mm).all()
    assert list(pieces_over(track, 20.5)) == []
