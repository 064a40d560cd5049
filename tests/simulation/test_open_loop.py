import dataclasses

import numpy as np
import pytest
import torch

from swarmtwin.dynamics.model_config import config_class
from swarmtwin.dynamics.predictor import NetworkDynamics
from swarmtwin.errors import UserError
from swarmtwin.geometry import compose
from swarmtwin.learning.situation import Situation
from swarmtwin.recordings.recording import Header, Recording, Track
from swarmtwin.simulation.open_loop import open_loop, rmse_mm, summary
from swarmtwin.simulation.simulation import Simulation
from swarmtwin.transitions import from_recording
from toy import DEAD_BAND, GAIN_MM_S, TRACK_MM, toy_track, toy_transitions


def predicted(dynamics, tracks):
    """Runs predicted by a simulation that is this dynamics model and nothing else."""
    return open_loop(Simulation(dynamics), tracks)


@pytest.fixture(scope="module")
def exact(robots):
    """The toy's own kinematics."""
    dynamics = NetworkDynamics(robots["mgr"], config_class("kinematic")()).eval()
    values = {"track_mm": TRACK_MM}
    for wheel in ("left", "right"):
        values |= {f"{wheel}_gain_mm_s_per_unit": GAIN_MM_S[wheel], f"{wheel}_dead_band": DEAD_BAND[wheel]}
    network = dynamics.network
    for name, value in values.items():
        torch.nn.init.constant_(network.free[name], np.log(value / network.parameters_by_name[name].size))
    return dynamics


def inexact(robots, *parts):
    torch.manual_seed(0)
    dynamics = NetworkDynamics(robots["mgr"], config_class("mlp")(situation=("command", *parts)))
    example = toy_transitions(robots["mgr"], 200)
    situation = Situation.from_transitions(example, dynamics.inputs)
    dynamics.learn_scaling(situation, torch.as_tensor(example.displacement, dtype=torch.float32))
    return dynamics.eval()


def test_the_exact_model_predicts_noise_free_runs(robots, exact):
    tracks = [toy_track(robots["mgr"], steps, seed) for seed, steps in enumerate((60, 7, 30))]
    runs = predicted(exact, tracks)
    for run, track in zip(runs, tracks, strict=True):
        np.testing.assert_allclose(run.predicted, track.pose, atol=1e-2)
        assert run.rmse_mm < 1e-2
    assert summary(runs).rmse_mm < 1e-2
    assert summary(runs).runs == 3


def test_the_rmse_of_three_steps_by_hand(robots, exact):
    measured = np.array([[100.0, 100.0, 0.0], [103.0, 104.0, 0.0], [np.nan] * 3, [100.0, 112.0, 0.0]])
    standing = np.array([[0.0, 0.0], [5.0, -5.0], [0.0, 0.0], [np.nan, np.nan]])  # zero, or within the dead band
    [run] = predicted(exact, [Track("r", "1", 0.5 * np.arange(4), standing, measured)])
    np.testing.assert_allclose(run.predicted, np.tile(measured[0], (4, 1)))
    assert run.rmse_mm == pytest.approx(np.sqrt((5**2 + 12**2) / 2))


def test_runs_predicted_together_are_the_runs_predicted_alone(robots):
    dynamics = inexact(robots, "previous_command", "pose", "elapsed_s", "duration_s")
    tracks = [toy_track(robots["mgr"], steps, seed) for seed, steps in enumerate((20, 3, 11))]
    together = predicted(dynamics, tracks)
    for run, track in zip(together, tracks, strict=True):
        [alone] = predicted(dynamics, [track])
        np.testing.assert_allclose(run.predicted, alone.predicted, rtol=1e-5, atol=1e-3)


def test_nothing_but_the_first_pose_is_used(robots):
    dynamics = inexact(robots, "previous_command", "pose")
    track = toy_track(robots["mgr"], 12)
    other = track.pose.copy()
    other[1:] += 77
    [run], [changed] = predicted(dynamics, [track]), predicted(dynamics, [dataclasses.replace(track, pose=other)])
    np.testing.assert_array_equal(run.predicted, changed.predicted)


def test_a_model_of_the_command_alone_moves_with_the_frame(robots):
    dynamics = inexact(robots)
    track = toy_track(robots["mgr"], 15)
    frame = np.array([300.0, -200.0, 2.0])
    turned = dataclasses.replace(track, pose=compose(np.tile(frame, (16, 1)), track.pose))
    [run], [moved] = predicted(dynamics, [track]), predicted(dynamics, [turned])
    np.testing.assert_allclose(
        moved.predicted[:, :2], compose(np.tile(frame, (16, 1)), run.predicted)[:, :2], atol=1e-6
    )
    assert moved.rmse_mm == pytest.approx(run.rmse_mm)


def test_the_previous_command_is_that_of_the_step_before(robots):
    dynamics = inexact(robots, "previous_command")
    seen = []
    handle = dynamics.encoding.register_forward_pre_hook(lambda _, arguments: seen.append(arguments[0]))
    track = toy_track(robots["mgr"], 4)
    predicted(dynamics, [track])
    handle.remove()
    previous = torch.cat([situation.previous_command for situation in seen])
    assert previous[0].isnan().all()
    np.testing.assert_allclose(previous[1:], track.command[:3], rtol=1e-6)


def test_the_earlier_command_is_that_of_two_steps_before(robots):
    """Of two runs at once; the second begins at its third row, where the command before is known, and none earlier."""
    dynamics = inexact(robots, "earlier_command")
    seen = []
    handle = dynamics.encoding.register_forward_pre_hook(lambda _, arguments: seen.append(arguments[0]))
    whole, late = toy_track(robots["mgr"], 5), toy_track(robots["mgr"], 7, seed=1)
    late.pose[:2] = np.nan
    predicted(dynamics, [whole, late])
    handle.remove()
    earlier = torch.stack([situation.earlier_command for situation in seen])
    assert earlier[0].isnan().all()
    assert earlier[1, 0].isnan().all()
    np.testing.assert_allclose(earlier[1, 1], late.command[1], rtol=1e-6)
    np.testing.assert_allclose(earlier[2:, 0], whole.command[:3], rtol=1e-6)
    np.testing.assert_allclose(earlier[2:, 1], late.command[2:5], rtol=1e-6)


@pytest.mark.parametrize("obstacle", ["command", "gap"])
def test_a_missing_command_or_a_gap_ends_the_prediction(robots, exact, obstacle):
    track = toy_track(robots["mgr"], 10)
    command, time_s = track.command.copy(), track.time_s.copy()
    if obstacle == "command":
        command[4] = np.nan
    else:
        time_s[5:] += 1.0
    [run] = predicted(exact, [dataclasses.replace(track, command=command, time_s=time_s)])
    assert np.isfinite(run.predicted[:5]).all()
    assert np.isnan(run.predicted[5:]).all()
    assert run.rmse_mm < 1e-2


def test_a_gap_as_long_as_the_longest_allowed_is_none(robots, exact):
    """Times are written to a millisecond: 0.6 s may be 0.6000000001 s in binary."""
    track = toy_track(robots["mgr"], 10)
    time_s = track.time_s.copy()
    time_s[5:] += robots["mgr"].longest_gap_s - robots["mgr"].period_s + 5e-7
    [run] = predicted(exact, [dataclasses.replace(track, time_s=time_s)])
    assert np.isfinite(run.predicted).all()


def test_a_run_begins_at_its_first_known_pose(robots, exact):
    track = toy_track(robots["mgr"], 10)
    pose = track.pose.copy()
    pose[:3] = np.nan
    [run] = predicted(exact, [dataclasses.replace(track, pose=pose)])
    assert np.isnan(run.predicted[:3]).all()
    np.testing.assert_allclose(run.predicted[3:], track.pose[3:], atol=1e-2)


def test_runs_that_cannot_be_predicted_are_left_out_of_the_summary(robots, exact):
    track = toy_track(robots["mgr"], 5)
    blind = dataclasses.replace(track, pose=np.full((6, 3), np.nan))
    mute = dataclasses.replace(track, command=np.full((6, 2), np.nan))
    runs = predicted(exact, [blind, track, mute])
    assert [np.isfinite(run.rmse_mm) for run in runs] == [False, True, False]
    assert summary(runs).runs == 1
    with pytest.raises(UserError) as error:
        summary(predicted(exact, [blind, mute]))
    assert str(error.value) == "no run can be predicted open loop: poses or commands are missing from the start"
    assert predicted(exact, []) == []


def test_rmse_of_nothing_is_not_a_number():
    assert np.isnan(rmse_mm(np.full((2, 3), np.nan), np.zeros((2, 3))))


# ---- neighbours


class Shy(torch.nn.Module):
    """Stands in for a dynamics model: every vehicle evades the mean of the others that it knows of."""

    inputs = ("command", "elapsed_s", "neighbours")

    def __init__(self, robot):
        super().__init__()
        self.robot, self.seen = robot, {}

    def predict(self, situation):
        for row, elapsed_s in enumerate(situation.elapsed_s.numpy()):
            self.seen.setdefault(float(elapsed_s), []).append(situation.neighbours[row].numpy())
        away = -0.02 * situation.neighbours.nanmean(dim=1).nan_to_num()
        return torch.cat([away[:, :2] + situation.command / 50, away[:, 2:]], dim=1)


def crowd(robot, late_s, runs=2, steps=8):
    """Tracks of vehicles that drive noise-free about 150 mm apart, their clocks `late_s` each; runs 60 s apart."""
    tracks = []
    for run in range(runs):
        for vehicle, late in enumerate(late_s):
            track = toy_track(robot, steps, seed=10 * run + vehicle, run=f"run-{run}", vehicle=str(vehicle))
            home = np.array([400.0 + 150 * vehicle, 500.0, 0.4 * vehicle])
            tracks.append(
                dataclasses.replace(track, time_s=track.time_s + 60 * run + late, pose=np.tile(home, (steps + 1, 1)))
            )
    return tracks


def recorded(robot, tracks):
    header = Header(robot=robot.name, period_s=robot.period_s, arena_mm=robot.arena_mm, source="made up")
    return from_recording(Recording(robot, header, tuple(tracks)))[0]


@pytest.mark.parametrize("late_s", [(0.0, 0.0, 0.0), (0.0, 0.1, -0.2), (0.0, 0.0, 0.22)])
def test_predicted_neighbours_are_those_that_a_recording_of_the_prediction_has(robots, late_s):
    """Also where the vehicles' clocks differ: the first rows of the early ones have nobody before them."""
    shy = Shy(robots["mgr"])
    tracks = crowd(robots["mgr"], late_s)
    runs = predicted(shy, tracks)
    assert max(np.abs(run.predicted[-1, :2] - run.track.pose[-1, :2]).max() for run in runs) > 5
    transitions = recorded(robots["mgr"], [dataclasses.replace(run.track, pose=run.predicted) for run in runs])
    assert len(transitions) == sum(len(track) - 1 for track in tracks)
    for elapsed_s, neighbours in shy.seen.items():
        rows = np.isclose(transitions.time_s, elapsed_s)
        np.testing.assert_allclose(neighbours, transitions.neighbours[rows], atol=1e-3)
    assert sum(map(len, shy.seen.values())) == len(transitions)


def test_who_is_not_predicted_is_where_it_was_measured_and_who_is_unknown_is_nowhere(robots):
    """The second vehicle has no command from row 4 on and is last seen in row 6."""
    first, second = crowd(robots["mgr"], (0.0, 0.0), runs=1)
    second.command[4:] = np.nan
    second.pose[:] += np.arange(9)[:, None] * [3.0, 0.0, 0.0]
    second.pose[7:] = np.nan
    shy = Shy(robots["mgr"])
    ahead, aside = predicted(shy, [first, second])
    shown = [
        compose(ahead.predicted[step].astype(float), shy.seen[step * 0.5][0][0].astype(float)) for step in range(8)
    ]
    np.testing.assert_allclose(shown[:5], aside.predicted[:5], atol=1e-3)
    assert not np.allclose(aside.predicted[1:5], second.pose[1:5], atol=1)
    np.testing.assert_allclose(shown[5:7], second.pose[5:7], atol=1e-3)
    assert np.isnan(shown[7]).all()


def test_vehicles_of_other_runs_are_not_seen(robots):
    shy = Shy(robots["mgr"])
    tracks = [
        dataclasses.replace(track, run=f"run-{index}") for index, track in enumerate(crowd(robots["mgr"], (0, 0)))
    ]
    runs = predicted(shy, tracks)
    assert {neighbours.shape for seen in shy.seen.values() for neighbours in seen} == {(0, 3)}
    for run, track in zip(runs, tracks, strict=True):
        moved = np.diff(run.predicted, axis=0)
        np.testing.assert_allclose(
            np.linalg.norm(moved[:, :2], axis=1), np.linalg.norm(track.command[:-1] / 50, axis=1), atol=1e-3
        )
