"""What of a recording is compared: all of it, long runs in blocks; of a very long one runs or blocks all over it."""

import dataclasses

import numpy as np
import pytest

from drives import drive, header_of
from swarmtwin.diagnosis.compared_runs import compared
from swarmtwin.recordings.blocks import run_of
from swarmtwin.recordings.recording import Recording


def recording_of(robot, runs, steps):
    return Recording(robot, header_of(robot), tuple(drive(robot, runs, steps)))


@pytest.mark.parametrize(("runs", "steps"), [(60, 30), (3, 700), (1, 2000)])
def test_nothing_is_left_out_of_what_is_not_too_long(robots, runs, steps):
    whole = recording_of(robots["mgr"], runs, steps)
    rows = sum(map(len, whole.tracks))
    parts, left_out = compared(whole, rows)
    assert left_out == 0
    assert sum(map(len, parts.tracks)) == rows
    assert len(parts.runs) == (60 if runs == 60 else pytest.approx(40, abs=3))
    assert dataclasses.replace(parts, tracks=()) == dataclasses.replace(whole, tracks=())


@pytest.mark.parametrize(("runs", "steps"), [(600, 30), (50, 900), (3, 9000), (1, 20000)])
def test_of_a_long_recording_runs_or_blocks_all_over_it_are_compared(robots, runs, steps):
    whole = recording_of(robots["mgr"], runs, steps)
    rows = sum(map(len, whole.tracks))
    parts, left_out = compared(whole, rows // 5)
    taken = sum(map(len, parts.tracks))
    assert left_out == rows - taken
    assert 0.8 * rows / 5 < taken <= 1.05 * rows / 5
    assert len(parts.runs) >= 35
    assert {run_of(name) for name in parts.runs} <= set(whole.runs)
    if runs <= 3:
        assert {run_of(name) for name in parts.runs} == set(whole.runs)
    begun_s = np.sort([track.time_s[0] for track in parts.tracks])
    length_s = max(track.time_s[-1] for track in whole.tracks)
    assert np.diff([0.0, *begun_s, length_s]).max() < length_s / 25


@pytest.mark.parametrize(("ahead_s", "begins_s", "in_doubt"), [(0, 0, False), (300, 300, True), (1e6, 0, False)])
def test_a_clock_that_shows_more_than_the_session_s_length_is_in_doubt(robots, ahead_s, begins_s, in_doubt):
    whole = recording_of(robots["mgr"], 12, 30)
    length_s = max(track.time_s[-1] for track in whole.tracks)
    assert 30 < length_s < 300
    tracks = tuple(dataclasses.replace(track, time_s=track.time_s + ahead_s) for track in whole.tracks)
    parts, _ = compared(dataclasses.replace(whole, tracks=tracks), 10**6)
    assert min(track.time_s[0] for track in parts.tracks) == pytest.approx(begins_s, abs=1.0)
    doubts = ["the measured session's clock begins at 300 s" in warning for warning in parts.warnings]
    assert doubts == [True] * in_doubt
