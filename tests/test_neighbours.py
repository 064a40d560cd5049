"""Neighbours are where the other vehicles of the run are, seen from the vehicle; what nobody knows is NaN."""

import dataclasses

import numpy as np
import pyarrow.parquet
import pytest

from drives import drive, header_of
from swarmtwin.geometry import compose
from swarmtwin.recordings.recording import Recording, Track
from swarmtwin.transitions import from_recording, load_transitions, save_transitions

UNKNOWN = np.full(3, np.nan)


@pytest.fixture
def mgr(robots):
    return robots["mgr"]


def transitions_of(robot, *tracks):
    return from_recording(Recording(robot, header_of(robot), tracks))[0]


def standing(robot, pose, vehicle="1", run="run", rows=5, late_s=0.0):
    """A vehicle that stands at a pose, with commands as if it drove, its clock `late_s` after the others'."""
    command = np.full((rows, len(robot.command)), 10.0)
    return Track(run, vehicle, robot.period_s * np.arange(rows) + late_s, command, np.tile(pose, (rows, 1)))


def creeping(robot, vehicle="2", rows=5, late_s=0.0):
    """A vehicle that creeps along x and turns past the half turn: 20 mm and 0.2 rad a second, from (500, 400, 3)."""
    track = standing(robot, np.zeros(3), vehicle, rows=rows, late_s=late_s)
    pose = np.array([500.0, 400.0, 3.0]) + np.outer(track.time_s, [20.0, 0.0, 0.2])
    pose[:, 2] = (pose[:, 2] + np.pi) % (2 * np.pi) - np.pi
    return dataclasses.replace(track, pose=pose)


def test_a_neighbour_is_in_the_vehicle_s_own_frame(mgr):
    """One looks up the arena, the other stands 200 mm ahead of it and 100 mm to its left and looks left of it."""
    found = transitions_of(
        mgr, standing(mgr, [400, 300, np.pi / 2], "1"), standing(mgr, [300, 500, np.pi], "2")
    ).neighbours
    assert found.shape == (8, 1, 3)
    np.testing.assert_allclose(found[:4, 0], np.tile([200, 100, np.pi / 2], (4, 1)), atol=1e-9)
    np.testing.assert_allclose(found[4:, 0], np.tile([-100, 200, -np.pi / 2], (4, 1)), atol=1e-9)


def test_whoever_is_in_the_run_is_seen_in_order_and_nobody_else(mgr):
    poses = {"1": [200, 200, 1.0], "2": [500, 300, -2.0], "3": [800, 800, 3.0]}
    three = [standing(mgr, pose, vehicle, "a") for vehicle, pose in poses.items()]
    two = [standing(mgr, poses[vehicle], vehicle, "b") for vehicle in ("1", "3")]
    transitions = transitions_of(mgr, *three, *two, standing(mgr, poses["2"], "2", "c"))
    assert transitions.neighbours.shape == (24, 2, 3)
    seen = compose(transitions.pose[:, None], transitions.neighbours)
    for index, vehicle in enumerate(poses):
        others = [poses[other] for other in poses if other != vehicle]
        rows = (transitions.vehicle == index) & (transitions.run == 0)
        np.testing.assert_allclose(seen[rows], np.tile(others, (4, 1, 1)), atol=1e-9)
    np.testing.assert_allclose(seen[(transitions.run == 1) & (transitions.vehicle == 0), 0][0], poses["3"], atol=1e-9)
    assert np.isnan(transitions.neighbours[transitions.run == 1][:, 1]).all()
    assert np.isnan(transitions.neighbours[transitions.run == 2]).all()


def test_vehicles_alone_have_no_neighbours(mgr):
    tracks = [standing(mgr, [500, 500, 0], run=run) for run in ("a", "b")]
    assert transitions_of(mgr, *tracks).neighbours.shape == (8, 0, 3)


def test_other_clocks_are_interpolated_also_past_the_half_turn(mgr):
    own, other = standing(mgr, [500, 300, 0]), creeping(mgr, rows=6, late_s=-0.18)
    assert (np.abs(np.diff(other.pose[:, 2])) > 6).any(), "the other should pass the half turn"
    transitions = transitions_of(mgr, own, other)
    seen = transitions.neighbours[transitions.vehicle == 0][:, 0]
    time_s = transitions.time_s[transitions.vehicle == 0]
    expected = np.array([0.0, 100.0, 3.0]) + np.outer(time_s, [20.0, 0.0, 0.2])
    np.testing.assert_allclose(seen[:, :2], expected[:, :2], atol=1e-9)
    np.testing.assert_allclose(np.exp(1j * seen[:, 2]), np.exp(1j * expected[:, 2]), atol=1e-9)


def test_a_missing_pose_is_unknown_and_its_row_alone(mgr):
    own, other = standing(mgr, [500, 300, 0]), creeping(mgr)
    other.pose[2] = np.nan
    seen = transitions_of(mgr, own, other).neighbours[:4, 0]
    np.testing.assert_array_equal(seen[2], UNKNOWN)
    assert np.isfinite(seen[[0, 1, 3]]).all()


@pytest.mark.parametrize(("late_s", "known"), [(0.2, True), (0.24, True), (0.26, False), (0.4, False)])
def test_the_nearest_pose_counts_within_half_a_period(mgr, late_s, known):
    """Of the other only one row is known, after the vehicle's row 2: nothing to interpolate with."""
    other = creeping(mgr, late_s=late_s)
    other.pose[[0, 1, 3, 4]] = np.nan
    seen = transitions_of(mgr, standing(mgr, [500, 300, 0]), other, standing(mgr, [50, 50, 0], "3")).neighbours[:4, 0]
    expected = other.pose[2] - [500, 300, 0] if known else UNKNOWN
    np.testing.assert_allclose(seen[2], expected, atol=1e-9)
    if late_s <= 0.25:
        np.testing.assert_array_equal(seen[[0, 1, 3]], np.tile(UNKNOWN, (3, 1)))


def test_nothing_is_interpolated_across_a_gap(mgr):
    """The other's rows 1 and 3 are 0.8 s apart, from 0.1 s before to 0.7 s after the vehicle's row 1."""
    own, other = standing(mgr, [500, 300, 0]), creeping(mgr)
    time_s = np.array([-0.1, 0.4, 1.2, 1.7, 2.2])
    seen = transitions_of(mgr, own, dataclasses.replace(other, time_s=time_s)).neighbours[:4, 0]
    np.testing.assert_allclose(seen[1], other.pose[1] - [500, 300, 0], atol=1e-9)


def test_rows_that_make_no_transition_are_seen_and_doubtful_markers_are_not(mgr):
    own, mute = standing(mgr, [500, 300, 0]), creeping(mgr)
    mute.command[1:] = np.nan
    transitions = transitions_of(mgr, own, mute)
    assert (transitions.vehicle == 1).sum() == 1
    assert np.isfinite(transitions.neighbours[:4]).all()
    jumped = creeping(mgr)
    jumped.pose[2:4] = [900, 900, 0]
    transitions = transitions_of(mgr, own, jumped)
    assert np.isnan(transitions.neighbours[:4]).any(axis=(1, 2)).tolist() == [False, False, True, True]


# ---- kept with the transitions


@pytest.fixture
def crowd(mgr):
    """Two runs of three vehicles, one of them unseen for a while."""
    tracks = drive(mgr, runs=2, steps=6, vehicles=("1", "2", "3"))
    tracks[1].pose[2:4] = np.nan
    return transitions_of(mgr, *tracks)


def test_neighbours_are_saved_and_an_older_file_has_none(crowd, tmp_path):
    assert np.isnan(crowd.neighbours).any()
    save_transitions(tmp_path, crowd)
    file = tmp_path / "transitions.parquet"
    table = pyarrow.parquet.read_table(file)
    np.testing.assert_array_equal(table.column("neighbour_2_left_mm").to_numpy(), crowd.neighbours[:, 1, 1])
    np.testing.assert_array_equal(load_transitions(tmp_path).neighbours, crowd.neighbours)
    older = [name for name in table.column_names if not name.startswith("neighbour_")]
    pyarrow.parquet.write_table(table.select(older), file)
    assert load_transitions(tmp_path).neighbours.shape == (len(crowd), 0, 3)


def test_transitions_of_vehicles_alone_have_no_columns_for_neighbours(mgr, tmp_path):
    save_transitions(tmp_path, transitions_of(mgr, standing(mgr, [500, 500, 0])))
    assert not [name for name in pyarrow.parquet.read_schema(tmp_path / "transitions.parquet").names if "neigh" in name]
    assert load_transitions(tmp_path).neighbours.shape == (4, 0, 3)
