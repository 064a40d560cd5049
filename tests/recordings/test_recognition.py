"""What was measured is recognised however long runs are cut, and nothing else is taken for it."""

import dataclasses
from pathlib import Path

import numpy as np
import pandas as pd
import pytest

from drives import header_of
from swarmtwin.errors import UserError
from swarmtwin.recordings.blocks import in_blocks
from swarmtwin.recordings.joining import joined
from swarmtwin.recordings.recognition import known_by, marks, recognised, row_hashes
from swarmtwin.recordings.recording import Recording, Track


def driven(run, rows, seed):
    """Return a track that wanders about, its numbers as a file holds them."""
    random = np.random.default_rng(seed)
    pose = np.cumsum(random.normal(0, (5.0, 5.0, 0.1), (rows, 3)), axis=0).round(3)
    return Track(run, "1", (0.5 * np.arange(rows)).round(3), random.integers(-80, 81, (rows, 2)).astype(float), pose)


@pytest.mark.parametrize(("runs", "rows", "again"), [(3, 900, 1), (39, 100, 5), (5, 3800, 2), (1, 400, 1)])
def test_a_part_of_a_recording_is_recognised_however_it_is_cut(runs, rows, again):
    drives = [driven(f"run_{number:05}", rows, number) for number in range(runs)]
    learned = set(known_by(in_blocks(drives)))
    copies = [dataclasses.replace(drive, run=f"drive_{number}") for number, drive in enumerate(drives[:again])]
    others = [driven(f"run_{number:05}", rows, 100 + number) for number in range(again)]
    as_part, as_others = in_blocks(copies), in_blocks(others)
    assert len({track.run for track in as_part}) > again  # they are cut otherwise than before
    assert all(recognised(as_part, learned))
    assert not any(recognised(as_others, learned))


def test_blocks_that_were_held_out_stay_unknown_where_a_run_is_cut_as_it_was():
    blocks = in_blocks([driven("run_00001", 900, 1)])
    learned = set(known_by(blocks[::2]))
    assert recognised(blocks, learned) == [number % 2 == 0 for number in range(len(blocks))]


def test_a_short_run_is_known_by_all_of_it(robots):
    run = driven("run_00001", 41, 1)
    assert known_by([run]) == (run.digest(),)
    recording = Recording(robots["mgr"], header_of(robots["mgr"]), (run,), digest="a")
    other = dataclasses.replace(recording, tracks=(driven("run_00001", 41, 2),), digest="b")
    both = joined({Path("one"): recording, Path("two"): other})
    assert recognised(both.tracks, {run.digest()}) == [True, False]


def test_a_vehicle_that_stands_still_is_known_by_all_of_it_alone():
    run = driven("run_00001", 900, 1)
    still = dataclasses.replace(run, pose=np.zeros((900, 3)), command=np.zeros((900, 2)))
    assert known_by([still]) == (still.digest(),)
    unseen = dataclasses.replace(run, pose=np.full((900, 3), np.nan))
    assert known_by([unseen]) == (unseen.digest(),)
    assert len(marks(run).transitions) > 30


def test_runs_of_which_the_beginning_alone_is_the_same_are_others():
    """Two recordings of a stand-in with one seed are the same until what is hidden in one of them first acts."""
    drives = [driven(f"run_{number:05}", 500, number) for number in range(4)]
    turned = [np.where(np.arange(500)[:, None] < 35, 0.0, [0.4, 0.1, 0.02]) for _ in drives]
    others = [
        dataclasses.replace(drive, pose=drive.pose + change) for drive, change in zip(drives, turned, strict=True)
    ]
    learned = set(known_by(in_blocks(drives)))
    own, shared = (np.concatenate([marks(one).transitions for one in each]) for each in (drives, others))
    assert np.isin(shared, own).sum() > 2
    assert not any(recognised(in_blocks(others), learned))
    # of drives that part in the middle, the blocks before are the same
    halves = [np.where(np.arange(500)[:, None] < 250, 0.0, [0.4, 0.1, 0.02]) for _ in drives]
    late = [dataclasses.replace(drive, pose=drive.pose + change) for drive, change in zip(drives, halves, strict=True)]
    assert any(recognised(in_blocks(late[:1], blocks=9), learned))


def test_another_vehicle_of_the_same_runs_is_unknown_however_they_are_cut():
    first = [driven(f"run_{number:05}", 300, number) for number in range(10)]
    second = [dataclasses.replace(driven(f"run_{number:05}", 300, 50 + number), vehicle="2") for number in range(10)]
    learned = set(known_by(first))
    both = in_blocks([track for pair in zip(first[:3], second[:3], strict=True) for track in pair])
    assert {track.vehicle for track, known in zip(both, recognised(both, learned), strict=True) if known} == {"1"}
    assert recognised(both, learned).count(True) == len(both) // 2


def test_what_a_very_long_recording_is_known_by_stays_small_and_is_recognised(monkeypatch):
    monkeypatch.setattr("swarmtwin.recordings.recognition.MOST_TRANSITIONS", 200)
    drives = [driven(f"run_{number:05}", 3000, number) for number in range(2)]  # some 370 transitions can be known
    learned = set(known_by(in_blocks(drives)))
    assert len("".join(learned)) < 16 * len(in_blocks(drives)) + 1100
    assert all(recognised(in_blocks(drives[:1]), learned))


def test_rows_have_the_hashes_that_pandas_gives_them():
    rows = np.random.default_rng(1).normal(0, 300, (200, 5)).round(3)
    whole = pd.DataFrame(np.rint(1000 * rows).astype(np.int64))
    np.testing.assert_array_equal(row_hashes(rows[:, 0], rows[:, 1:]), pd.util.hash_pandas_object(whole, index=False))
    assert len(row_hashes(rows[:0])) == 0


@pytest.mark.parametrize("damage", ["transitions:AAA", "transitions:AAAAAAA=", "transitions:%%%%"])
def test_damaged_marks_are_one_clear_error(damage):
    with pytest.raises(UserError, match=r"description is damaged at 'transitions:.*train it anew"):
        recognised([driven("run_00001", 90, 1)], {damage})
