"""Poses and commands with times of their own become rows without anything invented."""

import numpy as np
import pandas as pd
import pytest

from swarmtwin.errors import UserError
from swarmtwin.recordings.sent_commands import read_sent_commands
from swarmtwin.recordings.synchronising import cut_into_runs, synchronised

SENT_S = np.array([0.0, 0.5, 1.0, 1.5])
COMMANDS = np.array([[1.0, 2.0], [3, 4], [5, 6], [7, 8]])


def poses_of(times_s):
    return times_s, np.column_stack([100 * times_s, 50 - times_s, 0.2 * times_s])


def test_a_row_stands_at_the_time_of_its_command_with_the_pose_between_its_pictures():
    (track,) = synchronised({"1": poses_of(np.arange(-0.01, 2, 0.03))}, {"1": (SENT_S, COMMANDS)}, "run_1", 0.1)
    assert (track.run, track.vehicle) == ("run_1", "1")
    np.testing.assert_array_equal(track.time_s, SENT_S)
    np.testing.assert_array_equal(track.command, COMMANDS)
    np.testing.assert_allclose(track.pose, poses_of(SENT_S)[1], atol=1e-9)


def test_gaps_ends_and_vehicles_that_nobody_saw_have_no_pose():
    seen = np.concatenate([np.arange(0.4, 0.8, 0.03), np.arange(1.2, 1.45, 0.03)])
    tracks = synchronised({"1": poses_of(seen)}, {"1": (SENT_S, COMMANDS), "2": (SENT_S, COMMANDS)}, "run_1", 0.1)
    assert np.isnan(tracks[0].pose).all(axis=1).tolist() == [True, False, True, True]
    assert np.isnan(tracks[1].pose).all()


def test_headings_are_interpolated_along_the_shorter_arc():
    seen = np.array([0.0, 0.1]), np.array([[0, 0, 3.1], [0, 0, -3.1]])
    (track,) = synchronised({"1": seen}, {"1": (np.array([0.05]), COMMANDS[:1])}, "run_1", 0.2)
    assert abs(track.pose[0, 2]) == pytest.approx(np.pi)


def test_poses_out_of_order_and_twice_at_one_time_do_no_harm():
    times_s, pose = poses_of(np.arange(0, 2, 0.05))
    mixed = np.random.default_rng(1).permutation(np.concatenate([np.arange(len(times_s)), [3, 7]]))
    (track,) = synchronised({"1": (times_s[mixed], pose[mixed])}, {"1": (SENT_S, COMMANDS)}, "run_1", 0.1)
    np.testing.assert_allclose(track.pose, poses_of(SENT_S)[1], atol=1e-9)


def test_runs_are_cut_at_the_same_times_for_all_and_lose_no_row_but_single_ones():
    poses = {one: poses_of(np.arange(0, 5, 0.05)) for one in "12"}
    sent_s = np.arange(0.0, 4.6, 0.5)
    commands = {"1": (sent_s, np.ones((10, 2))), "2": (sent_s[:-1] + 0.1, np.ones((9, 2)))}
    pieces = cut_into_runs(synchronised(poses, commands, "run", 0.1), 2.0)
    assert [(one.run, one.vehicle, len(one)) for one in pieces] == [
        ("run_001", "1", 4),
        ("run_001", "2", 4),
        ("run_002", "1", 4),
        ("run_002", "2", 4),
        ("run_003", "1", 2),
    ]
    assert cut_into_runs([], 2.0) == []


def test_commands_are_read_from_csv_and_parquet_in_any_order(robots, tmp_path):
    table = pd.DataFrame(
        {"vehicle": ["2", "1", "1"], "time_s": [0.0, 1.0, 0.5], "right": [1, 2, 3], "left": [4, 5, 6], "reason": "x"}
    )
    table.to_csv(tmp_path / "sent.csv", index=False)
    table.to_parquet(tmp_path / "sent.parquet")
    table.set_axis([1200, 0, 0]).to_parquet(tmp_path / "of_another_table.parquet")  # pandas writes its index
    for file in ("sent.csv", "sent.parquet", "of_another_table.parquet"):
        sent = read_sent_commands(tmp_path / file, robots["mgr"])
        assert set(sent) == {"1", "2"}
        np.testing.assert_array_equal(sent["1"][0], [0.5, 1.0])
        np.testing.assert_array_equal(sent["1"][1], [[6, 3], [5, 2]])


def test_a_file_that_is_no_table_is_refused(robots, tmp_path):
    (tmp_path / "sent.csv").write_bytes(b"\xff\xfe\x00")
    with pytest.raises(UserError, match="cannot be read"):
        read_sent_commands(tmp_path / "sent.csv", robots["mgr"])
