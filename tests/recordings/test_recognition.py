"""What was measured is recognised however long runs are cut, and nothing else is taken for it."""

import dataclasses
from pathlib import Path

import numpy as np
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
    assert len(marks(run).transitions) > 150


def test_a_vehicle_that_stands_still_is_known_with_one_that_moved_in_the_same_run():
    runs = [driven(f"run_{number:05}", 900, number) for number in range(3)]
    parked = [dataclasses.replace(run, vehicle="2", pose=np.full((900, 3), 700.0)) for run in runs]
    learned = set(known_by(in_blocks([track for pair in zip(runs, parked, strict=True) for track in pair])))
    assert all(recognised(in_blocks([runs[0], parked[0]]), learned))
    other = driven("run_00001", 900, 9)
    assert not any(recognised(in_blocks([other, dataclasses.replace(parked[0], run=other.run)]), learned))


def test_a_format_of_fewer_digits_holds_the_same_runs():
    runs = [driven(f"run_{number:05}", 41, number) for number in range(200)]
    runs = [dataclasses.replace(run, pose=run.pose.round(4) * [1, 1, 0.1]) for run in runs]  # halves of thousandths
    single = [dataclasses.replace(run, pose=run.pose.astype(np.float32).astype(float)) for run in runs]
    assert sum(run.digest() == copy.digest() for run, copy in zip(runs, single, strict=True)) < 190
    learned = set(known_by(runs[:100]))
    assert recognised(single, learned) == [True] * 100 + [False] * 100


def test_runs_that_go_on_in_the_same_file_are_known_where_they_were_learned_from():
    whole = driven("run_00001", 8000, 1)
    first = dataclasses.replace(whole, **{name: getattr(whole, name)[:5000] for name in ("time_s", "command", "pose")})
    found = recognised(in_blocks([whole]), set(known_by(in_blocks([first]))))
    assert found == [True] * 25 + [False] * 15


def test_drives_of_two_blocks_are_recognised_each():
    drives = [driven(f"run_{number:05}", 80, number) for number in range(300)]
    learned = set(known_by(drives))
    assert all(all(recognised(in_blocks([dataclasses.replace(one, run="drive_1")]), learned)) for one in drives)


def test_runs_of_which_the_beginning_alone_is_the_same_are_others():
    """Two recordings of a stand-in with one seed are the same until what is hidden in one of them first acts."""
    drives = [driven(f"run_{number:05}", 500, number) for number in range(4)]
    turned = [np.where(np.arange(500)[:, None] < 35, 0.0, [0.4, 0.1, 0.02]) for _ in drives]
    others = [
        dataclasses.replace(drive, pose=drive.pose + change) for drive, change in zip(drives, turned, strict=True)
    ]
    learned = set(known_by(in_blocks(drives)))
    own, shared = (np.concatenate([marks(one).transitions for one in each]) for each in (drives, others))
    assert np.isin(shared, own).sum() > 10
    assert not any(recognised(in_blocks(others), learned))
    # of drives that part in the middle, the blocks before are the same
    halves = [np.where(np.arange(500)[:, None] < 250, 0.0, [0.4, 0.1, 0.02]) for _ in drives]
    late = [dataclasses.replace(drive, pose=drive.pose + change) for drive, change in zip(drives, halves, strict=True)]
    found = recognised(in_blocks(late[:1], blocks=9), learned)
    assert found[:3] == [True] * 3
    assert found[-3:] == [False] * 3


def test_another_vehicle_of_the_same_runs_is_unknown_however_they_are_cut():
    first = [driven(f"run_{number:05}", 300, number) for number in range(10)]
    second = [dataclasses.replace(driven(f"run_{number:05}", 300, 50 + number), vehicle="2") for number in range(10)]
    learned = set(known_by(first))
    both = in_blocks([track for pair in zip(first[:3], second[:3], strict=True) for track in pair])
    assert {track.vehicle for track, known in zip(both, recognised(both, learned), strict=True) if known} == {"1"}
    assert recognised(both, learned).count(True) == len(both) // 2


def test_what_a_very_long_recording_is_known_by_stays_small_and_is_recognised(monkeypatch):
    monkeypatch.setattr("swarmtwin.recordings.recognition.MOST_TRANSITIONS", 500)
    drives = [driven(f"run_{number:05}", 6000, number) for number in range(2)]  # some 3,000 transitions can be known
    learned = set(known_by(in_blocks(drives)))
    assert len("".join(learned)) < 16 * len(in_blocks(drives)) + 2700
    assert all(recognised(in_blocks(drives[:1]), learned))
    assert not any(recognised(in_blocks([driven("run_00001", 6000, 9)]), learned))
    beside = learned | set(known_by([driven("run_00009", 90, 9)]))  # an extension knows two recordings
    assert all(recognised(in_blocks(drives[:1]), beside))


def test_rows_that_are_the_same_to_a_thousandth_have_one_hash_and_others_another():
    rows = np.random.default_rng(1).normal(0, 300, (20_000, 5)).round(3)
    hashes = row_hashes(rows[:, 0], rows[:, 1:])
    np.testing.assert_array_equal(hashes, row_hashes(rows + 2e-4))
    for others in (rows[:, ::-1], rows + np.eye(5)[4] / 1000, -rows):
        assert not np.isin(row_hashes(others), hashes).any()
    assert len(np.unique(hashes)) == 20_000
    assert len(np.unique(hashes >> 32)) > 19_990  # of which 32 bits are kept
    np.testing.assert_allclose(np.bincount(hashes % 4, minlength=4) / 20_000, 0.25, atol=0.02)
    assert len(row_hashes(rows[:0])) == 0


@pytest.mark.parametrize("damage", ["transitions:AAA", "transitions:AAAAAAA=", "transitions:%%%%"])
def test_damaged_marks_are_one_clear_error(damage):
    with pytest.raises(UserError, match=r"description is damaged at 'transitions:.*train it anew"):
        recognised([driven("run_00001", 90, 1)], {damage})
