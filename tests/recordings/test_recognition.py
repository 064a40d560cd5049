"""What was measured is recognised however long runs are cut, and nothing else is taken for it."""

import dataclasses
from pathlib import Path

import numpy as np
import pytest

from drives import header_of
from swarmtwin.recordings.blocks import in_blocks
from swarmtwin.recordings.joining import joined
from swarmtwin.recordings.recognition import marks, recognised
from swarmtwin.recordings.recording import Recording, Track


def driven(run, rows, seed):
    """Return a track that wanders about, its numbers as a file holds them."""
    random = np.random.default_rng(seed)
    pose = np.cumsum(random.normal(0, (5.0, 5.0, 0.1), (rows, 3)), axis=0).round(3)
    return Track(run, "1", (0.5 * np.arange(rows)).round(3), random.integers(-80, 81, (rows, 2)).astype(float), pose)


def known_of(tracks):
    return {mark for track in tracks for mark in marks(track)}


@pytest.mark.parametrize(("runs", "rows", "again"), [(3, 900, 1), (39, 100, 5), (5, 3800, 2), (1, 400, 1)])
def test_a_part_of_a_recording_is_recognised_however_it_is_cut(runs, rows, again):
    drives = [driven(f"run_{number:05}", rows, number) for number in range(runs)]
    learned = known_of(in_blocks(drives))
    copies = [dataclasses.replace(drive, run=f"drive_{number}") for number, drive in enumerate(drives[:again])]
    others = [driven(f"run_{number:05}", rows, 100 + number) for number in range(again)]
    as_part, as_others = in_blocks(copies), in_blocks(others)
    assert len({track.run for track in as_part}) > again  # they are cut otherwise than before
    assert all(recognised(as_part, learned))
    assert not any(recognised(as_others, learned))


def test_blocks_that_were_held_out_stay_unknown_where_a_run_is_cut_as_it_was():
    blocks = in_blocks([driven("run_00001", 900, 1)])
    learned = known_of(blocks[::2])
    assert recognised(blocks, learned) == [number % 2 == 0 for number in range(len(blocks))]


def test_a_short_run_is_known_by_all_of_it(robots):
    run = driven("run_00001", 41, 1)
    assert marks(run) == (run.digest(),)
    recording = Recording(robots["mgr"], header_of(robots["mgr"]), (run,), digest="a")
    other = dataclasses.replace(recording, tracks=(driven("run_00001", 41, 2),), digest="b")
    both = joined({Path("one"): recording, Path("two"): other})
    assert recognised(both.tracks, {run.digest()}) == [True, False]


def test_a_vehicle_that_stands_still_is_known_by_all_of_it_alone():
    run = driven("run_00001", 900, 1)
    still = dataclasses.replace(run, pose=np.zeros((900, 3)), command=np.zeros((900, 2)))
    assert marks(still) == (still.digest(),)
    unseen = dataclasses.replace(run, pose=np.full((900, 3), np.nan))
    assert marks(unseen) == (unseen.digest(),)
    assert len(marks(run)) > 5
