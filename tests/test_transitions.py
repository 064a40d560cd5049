"""Transitions are what was measured, in the right frame; what is not to be believed is dropped under its reason."""

import dataclasses

import numpy as np
import pytest

from drives import drive, header_of
from swarmtwin.errors import UserError
from swarmtwin.geometry import compose, integrate_twist
from swarmtwin.recordings.recording import Recording, Track
from swarmtwin.robot import Arena, LargestDisplacement
from swarmtwin.transitions import Transitions, from_recording

STEPS = 20


@pytest.fixture
def mgr(robots):
    return robots["mgr"]


def recording_of(robot, tracks):
    return Recording(robot, header_of(robot), tuple(tracks))


def transitions_of(robot, tracks):
    return from_recording(recording_of(robot, tracks))


def straight_track(robot, steps=STEPS, run="run", vehicle="1", speed_mm=20.0, start=(100.0, 500.0, 0.0)):
    """A vehicle that drives straight on, `speed_mm` a period."""
    count = np.arange(steps + 1)
    pose = compose(np.array(start), np.stack([count * speed_mm, 0.0 * count, 0.0 * count], axis=-1))
    command = np.full((steps + 1, 2), 50.0) + count[:, None]
    command[-1] = np.nan
    return Track(run, vehicle, count * robot.period_s, command, pose)


def kept_starts(transitions):
    """The numbers of the rows, in a run of constant period, at which transitions start."""
    return (transitions.time_s / transitions.robot.period_s).round().astype(int).tolist()


# ---- displacements


def test_a_displacement_is_in_the_vehicle_s_frame_at_the_start(mgr):
    pose = np.array([[500.0, 500.0, np.pi / 2], [490.0, 530.0, np.pi / 2 + 0.1]])
    track = Track("run", "1", np.array([0.0, 0.5]), np.array([[10.0, 20.0], [np.nan, np.nan]]), pose)
    transitions, _ = transitions_of(mgr, [track])
    np.testing.assert_allclose(transitions.displacement, [[30.0, 10.0, 0.1]], atol=1e-9)
    np.testing.assert_array_equal(transitions.command, [[10.0, 20.0]])


def test_displacements_lead_from_pose_to_pose(mgr):
    tracks = drive(mgr, runs=3, steps=STEPS)
    transitions, counts = transitions_of(mgr, tracks)
    assert counts.kept == counts.considered == 3 * 2 * STEPS
    ends = np.concatenate([track.pose[1:] for track in tracks])
    np.testing.assert_allclose(compose(transitions.pose, transitions.displacement), ends, atol=1e-9)


def test_displacements_do_not_depend_on_the_arena_s_frame(mgr):
    tracks = drive(mgr, steps=STEPS)
    reference, _ = transitions_of(mgr, tracks)
    frame = np.array([900.0, -100.0, 1.0])
    turned, _ = transitions_of(mgr, [dataclasses.replace(track, pose=compose(frame, track.pose)) for track in tracks])
    assert not np.allclose(turned.pose, reference.pose)
    np.testing.assert_allclose(turned.displacement, reference.displacement, atol=1e-9)


def test_order_is_run_then_vehicle_then_time(mgr):
    transitions, _ = transitions_of(mgr, drive(mgr, runs=3, steps=5, vehicles=("1", "2", "3")))
    order = np.lexsort((transitions.time_s, transitions.vehicle, transitions.run))
    np.testing.assert_array_equal(order, np.arange(len(transitions)))


def test_no_transition_crosses_runs_or_vehicles(mgr):
    tracks = [straight_track(mgr, 1, run, vehicle) for run in ("a", "b") for vehicle in ("1", "2")]
    transitions, counts = transitions_of(mgr, tracks)
    assert counts.considered == len(transitions) == 4
    assert np.isnan(transitions.previous_command).all()


def test_previous_commands_are_those_held_before(mgr):
    track = straight_track(mgr)
    track.time_s[8:] += 3.0
    track.command[12] = np.nan
    transitions, counts = transitions_of(mgr, [track])
    assert counts.dropped == {"no_command": 1, "gap": 1}
    rows = [row for row in range(STEPS) if row not in (7, 12)]
    np.testing.assert_array_equal(transitions.command, track.command[rows])
    for row, previous in zip(rows, transitions.previous_command, strict=True):
        expected = np.full(2, np.nan) if row in (0, 8, 13) else track.command[row - 1]
        np.testing.assert_array_equal(previous, expected)


def test_earlier_commands_are_those_held_before_the_previous_ones(mgr):
    """Of two runs: nothing before row 0, a gap after row 7, no command in row 12, one that is not allowed in row 16."""
    tracks = [straight_track(mgr, run="a"), straight_track(mgr, run="b")]
    for track in tracks:
        track.time_s[8:] += 3.0
        track.command[12] = np.nan
        track.command[16, 0] = 120.5
    transitions, _ = transitions_of(mgr, tracks)
    rows = [row for row in range(STEPS) if row not in (7, 12, 16)]
    assert len(transitions) == 2 * len(rows)
    unknown = (0, 1, 8, 9, 13, 14, 17, 18)
    expected = [np.full(2, np.nan) if row in unknown else tracks[0].command[row - 2] for row in rows]
    np.testing.assert_array_equal(transitions.earlier_command, np.tile(expected, (2, 1)))
    without_previous = np.isnan(transitions.previous_command)
    assert np.isnan(transitions.earlier_command[without_previous]).all()


def test_a_transition_that_is_dropped_for_its_pose_still_lends_its_command(mgr):
    track = straight_track(mgr)
    track.pose[5] = np.nan
    transitions, _ = transitions_of(mgr, [track])
    rows = [row for row in range(2, STEPS) if row not in (4, 5)]
    np.testing.assert_array_equal(transitions.earlier_command[2:], track.command[np.array(rows) - 2])


def test_the_velocity_is_the_twist_of_the_period_before_over_its_length(mgr):
    """An arc of a quarter turn a second at 100 mm/s: measured over 0.55 s, it is the same twist at its end."""
    twist = np.array([100.0, 10.0, np.pi / 2])
    time_s = np.array([0.0, 0.5, 1.05, 1.5])
    pose = compose(np.array([500.0, 500.0, 2.0]), integrate_twist(twist, 1.0 * time_s[:, None])[:, 0])
    command = np.array([[10.0, 20.0]] * 3 + [[np.nan, np.nan]])
    robot = mgr.model_copy(update={"largest_displacement": LargestDisplacement(forward_mm=99, left_mm=99, turn_rad=3)})
    transitions, _ = transitions_of(robot, [Track("run", "1", time_s, command, pose)])
    assert np.isnan(transitions.velocity[0]).all()
    np.testing.assert_allclose(transitions.velocity[1:], [twist, twist], atol=1e-9)


def test_the_velocity_is_unknown_where_nothing_believable_ends(mgr):
    """Nothing before row 0, a gap after row 7, no pose in row 12, no command in row 16, another vehicle's rows."""
    tracks = [straight_track(mgr, vehicle="1"), straight_track(mgr, vehicle="2", start=(100.0, 900.0, 0.0))]
    for track in tracks:
        track.time_s[8:] += 3.0
        track.pose[12] = np.nan
        track.command[16] = np.nan
    transitions, _ = transitions_of(mgr, tracks)
    rows = np.array([row for row in range(STEPS) if row not in (7, 11, 12, 16)])
    known = np.isfinite(transitions.velocity).all(axis=1)
    np.testing.assert_array_equal(known, np.tile(~np.isin(rows, (0, 8, 13, 17)), 2))
    np.testing.assert_allclose(transitions.velocity[known], [[40.0, 0.0, 0.0]] * known.sum(), atol=1e-9)


def test_velocities_go_with_their_transitions(mgr):
    transitions, _ = transitions_of(mgr, drive(mgr, runs=2, steps=STEPS))
    some = np.random.default_rng(1).random(len(transitions)) < 0.5
    np.testing.assert_array_equal(transitions.where(some).velocity, transitions.velocity[some])
    again = dataclasses.replace(transitions.where(some), velocity=np.empty((0, 3)))
    assert np.isnan(again.velocity).sum() > np.isnan(transitions.velocity[some]).sum()


# ---- reasons

SINGLE_FAULTS = [
    # what is done to row 5, the reason, the starts of the transitions that are lost
    (lambda track: track.command.__setitem__(5, np.nan), {"no_command": 1}, [5]),
    (lambda track: track.command.__setitem__((5, 0), 120.5), {"command_out_of_limits": 1}, [5]),
    (lambda track: track.command.__setitem__((5, 1), -120.5), {"command_out_of_limits": 1}, [5]),
    (lambda track: track.pose.__setitem__(5, np.nan), {"no_pose": 2}, [4, 5]),
    (lambda track: track.pose.__setitem__((5, 1), 540.0), {"outlier": 2}, [4, 5]),
    (lambda track: track.pose.__setitem__((5, 2), 1.5), {"outlier": 2}, [4, 5]),
    (lambda track: track.pose.__setitem__((5, 1), 900.0), {"teleport": 2}, [4, 5]),
]


@pytest.mark.parametrize(("spoil", "dropped", "lost"), SINGLE_FAULTS)
def test_a_fault_of_one_row_costs_its_own_transitions(mgr, spoil, dropped, lost):
    track = straight_track(mgr)
    spoil(track)
    transitions, counts = transitions_of(mgr, [track])
    assert counts.dropped == dropped
    assert (counts.rows, counts.considered, counts.kept) == (STEPS + 1, STEPS, STEPS - len(lost))
    assert kept_starts(transitions) == [row for row in range(STEPS) if row not in lost]


@pytest.mark.parametrize(
    ("duration_s", "dropped"),
    [(0.6, {}), (0.602, {"gap": 1}), (30.0, {"gap": 1}), (0.5, {}), (0.25, {}), (0.248, {"short_period": 1})],
)
def test_a_period_may_last_from_half_its_length_to_the_longest_gap(mgr, duration_s, dropped):
    track = straight_track(mgr, speed_mm=10.0)
    track.time_s[6:] += duration_s - mgr.period_s
    transitions, counts = transitions_of(mgr, [track])
    assert counts.dropped == dropped
    assert (5 in kept_starts(transitions.where(transitions.time_s <= 2.5))) == (not dropped)
    np.testing.assert_allclose(np.delete(transitions.duration_s, slice(5, 6)), mgr.period_s)


def test_outlier_limits_grow_and_shrink_with_the_duration(mgr):
    """50 mm in 0.5 s is the limit: 55 mm is believable in 0.6 s, and 45 mm is not in 0.4 s."""
    for duration_s, moved_mm, believable in ((0.6, 55, True), (0.5, 51, False), (0.4, 45, False), (0.4, 39, True)):
        pose = np.array([[500.0, 500.0, 0.3], [500 + moved_mm * np.cos(0.3), 500 + moved_mm * np.sin(0.3), 0.3]])
        track = Track("run", "1", np.array([0.0, duration_s]), np.zeros((2, 2)), pose)
        good = straight_track(mgr, run="good")
        _, counts = transitions_of(mgr, [good, track])
        assert counts.dropped == ({} if believable else {"outlier": 1})


def test_outside_the_arena_is_dropped_only_when_both_poses_are(mgr):
    """The arena ends at x = 1030 mm, the tolerance is half a vehicle's length, 45 mm: rows 0 and 1 are inside."""
    track = straight_track(mgr, steps=4, start=(1040.0, 500.0, 0.0))
    transitions, counts = transitions_of(mgr, [track])
    assert counts.dropped == {"outside_arena": 2}
    assert kept_starts(transitions) == [0, 1]


def test_the_recording_s_own_arena_counts(mgr):
    track = straight_track(mgr)
    header = header_of(mgr).model_copy(update={"arena_mm": Arena(x=(0, 200), y=(0, 1000))})
    transitions, counts = from_recording(Recording(mgr, header, (track,)))
    assert counts.dropped == {"outside_arena": STEPS - len(transitions)}
    assert transitions.pose[:, 0].max() == 240


def test_rows_set_aside_while_reading_stay_counted(mgr):
    recording = dataclasses.replace(recording_of(mgr, [straight_track(mgr)]), dropped_rows={"duplicate_row": 3})
    assert from_recording(recording)[1].dropped_rows == {"duplicate_row": 3}


def test_nothing_left_is_an_error_that_says_why(mgr):
    track = straight_track(mgr)
    track.pose[:] = np.nan
    track.command[3] = np.nan
    with pytest.raises(UserError) as refused:
        transitions_of(mgr, [track])
    assert str(refused.value) == (
        "recording of robot 'mgr': no transition is left of 20, dropped: no_command 1, no_pose 19"
    )


def test_single_rows_are_an_error(mgr):
    with pytest.raises(UserError) as refused:
        transitions_of(mgr, [straight_track(mgr, steps=0)])
    assert str(refused.value) == "recording of robot 'mgr': no vehicle has two rows in one run: record longer runs"


# ---- markers


def swap_markers(one, other, first, last):
    """Exchange the poses of two tracks of the same ticks."""
    one.pose[first:last], other.pose[first:last] = other.pose[first:last].copy(), one.pose[first:last].copy()


@pytest.mark.parametrize("distance_mm", [95.0, 300.0])
@pytest.mark.parametrize(("first", "last"), [(5, 6), (5, 9), (5, STEPS + 1), (STEPS, STEPS + 1)])
def test_a_swapped_marker_costs_both_vehicles_everything_until_it_is_swapped_back(mgr, distance_mm, first, last):
    """Also for vehicles so near to each other, 95 mm ahead, that the jump alone could be an outlier."""
    tracks = [straight_track(mgr, vehicle="1"), straight_track(mgr, vehicle="2", start=(100 + distance_mm, 500, 0))]
    swap_markers(*tracks, first, last)
    transitions, counts = transitions_of(mgr, tracks)
    right = [row for row in range(STEPS) if not (first - 1 <= row < last)]
    for vehicle in (0, 1):
        assert kept_starts(transitions.where(transitions.vehicle == vehicle)) == right
    ends = 1 if last > STEPS else 2
    inside = {"doubtful_marker": 2 * (last - first - 1)} if last - first > 1 else {}
    assert counts.dropped == {**inside, "teleport": 2 * ends}


def test_a_marker_lost_while_it_is_swapped_is_not_trusted_when_it_returns(mgr):
    tracks = [straight_track(mgr, vehicle="1"), straight_track(mgr, vehicle="2", start=(500, 500, 0))]
    swap_markers(*tracks, 8, STEPS + 1)
    tracks[0].pose[6:10] = np.nan
    transitions, _ = transitions_of(mgr, tracks)
    assert kept_starts(transitions.where(transitions.vehicle == 0)) == [0, 1, 2, 3, 4]
    assert kept_starts(transitions.where(transitions.vehicle == 1)) == [0, 1, 2, 3, 4, 5, 6]


def test_a_false_marker_seen_for_a_while_is_dropped(mgr):
    track = straight_track(mgr)
    track.pose[7:11] = [900.0, 900.0, 0.0]
    transitions, counts = transitions_of(mgr, [track])
    assert kept_starts(transitions) == [row for row in range(STEPS) if not 6 <= row <= 10]
    assert counts.dropped == {"doubtful_marker": 3, "teleport": 2}


def test_a_vehicle_alone_that_is_moved_by_hand_is_trusted_again(mgr):
    track = straight_track(mgr)
    track.pose[7:, 1] += 300.0
    transitions, counts = transitions_of(mgr, [track])
    assert kept_starts(transitions) == [row for row in range(STEPS) if row != 6]
    assert counts.dropped == {"teleport": 1}


def test_a_first_pose_that_is_false_costs_one_transition(mgr):
    tracks = [straight_track(mgr, vehicle="1"), straight_track(mgr, vehicle="2", start=(100, 800, 0))]
    tracks[0].pose[0] = [900.0, 100.0, 0.0]
    _, counts = transitions_of(mgr, tracks)
    assert counts.dropped == {"teleport": 1}


# ---- the type


def test_parts_and_choices_keep_everything_aligned(mgr):
    transitions, _ = transitions_of(mgr, drive(mgr, runs=3, steps=5))
    chosen = transitions.where(np.array([3, 17, 29]))
    for field in dataclasses.fields(Transitions):
        value = getattr(transitions, field.name)
        if isinstance(value, np.ndarray):
            np.testing.assert_array_equal(getattr(chosen, field.name), value[[3, 17, 29]])
    assert (chosen.runs, chosen.vehicles) == (transitions.runs, transitions.vehicles)
    assert len(transitions.part("train")) == len(transitions)
    assert len(transitions.part("test")) == 0
