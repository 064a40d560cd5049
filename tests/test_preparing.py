"""Preparing in parts: the transitions, splits and descriptions of a recording that is prepared whole, or nothing."""

import dataclasses

import numpy as np
import pyarrow.parquet
import pytest
from matplotlib.figure import Figure

from drives import drive, write_drive
from swarmtwin.errors import UserError
from swarmtwin.learning.batches import tensor_splits
from swarmtwin.recordings.reading import read_recording
from swarmtwin.studies.tracked_inputs import split_inputs
from swarmtwin.transitions import (
    SPLITS,
    Fractions,
    SplitOptions,
    from_recording,
    held_out,
    load_preparation,
    load_transitions,
    split_by_run,
)
from swarmtwin.transitions.displacement_plots import _draw_runs
from swarmtwin.transitions.preparation import describe, save_preparation, stored_transitions
from swarmtwin.transitions.preparing import prepare
from swarmtwin.transitions.transitions import array_fields

SPLIT = SplitOptions(fractions=Fractions(train=0.7, validation=0.2, test=0.1), seed=3)


@pytest.fixture
def mgr(robots):
    return robots["mgr"]


@pytest.fixture
def recording(mgr, tmp_path):
    """Thirty runs of one, two or three vehicles; poses and commands are lost, markers jump, and one run has no pose."""
    tracks = []
    for run in range(30):
        vehicles = ("3", "1", "2")[: 1 + run % 3]
        for track in drive(mgr, runs=1, steps=20 + run, vehicles=vehicles, seed=run):
            tracks.append(dataclasses.replace(track, run=f"run_{run:03}", time_s=track.time_s + 100 * run))
    rng = np.random.default_rng(1)
    for track in tracks:
        track.pose[rng.random(len(track)) < 0.05] = np.nan
        track.command[rng.random(len(track)) < 0.05] = np.nan
        track.pose[rng.random(len(track)) < 0.02, 0] += 900
        if track.run == "run_011":
            track.pose[:] = np.nan
    return write_drive(tmp_path / "monday", mgr, tracks, "one_file")


def in_small_groups(file):
    """Write a recording's file anew, in groups of 100 rows, each of them checked by its pages."""
    table = pyarrow.parquet.read_table(file)
    pyarrow.parquet.write_table(table, file, row_group_size=100, write_page_checksum=True, use_dictionary=False)


def flip(file, place):
    """Damage one byte at a share of a file's length."""
    content = bytearray(file.read_bytes())
    content[int(place * len(content))] ^= 0xFF
    file.write_bytes(content)


def prepared(recording, robot, folder, rows, vehicles=None):
    folder.mkdir()
    prepare(recording, robot, SPLIT, folder, vehicles, rows)
    return folder


def prepared_whole(recording, robot, folder, vehicles=None):
    """What preparing is by its definition: read, extract, split, describe, save."""
    folder.mkdir()
    read = read_recording(recording, robot)
    read = read.where(lambda track: vehicles is None or track.vehicle in vehicles)
    transitions, counts = from_recording(read)
    transitions = split_by_run(transitions, SPLIT.fractions, SPLIT.seed)
    about = describe(read, recording.name, transitions, counts, SPLIT.fractions, SPLIT.seed)
    save_preparation(folder, transitions, about)
    return folder


def assert_same(found, expected):
    assert (found.robot, found.arena_mm) == (expected.robot, expected.arena_mm)
    assert (found.runs, found.vehicles) == (expected.runs, expected.vehicles)
    for name in array_fields():
        np.testing.assert_array_equal(getattr(found, name), getattr(expected, name), err_msg=name)
        assert getattr(found, name).dtype == getattr(expected, name).dtype


@pytest.mark.parametrize("rows", [1, 300, 10**6])
@pytest.mark.parametrize("vehicles", [None, ("1", "2")])
def test_prepared_in_parts_is_prepared_whole(recording, mgr, tmp_path, rows, vehicles):
    found = prepared(recording, mgr, tmp_path / "parts", rows, vehicles)
    expected = prepared_whole(recording, mgr, tmp_path / "whole", vehicles)
    assert sorted(path.name for path in found.iterdir()) == ["preparation.json", "transitions.parquet"]
    assert (found / "preparation.json").read_bytes() == (expected / "preparation.json").read_bytes()
    whole, parted = load_transitions(expected), load_transitions(found)
    assert_same(parted, whole)
    assert whole.neighbours.shape[1] == (2 if vehicles is None else 1)
    one_part = rows == 10**6
    files = [(folder / "transitions.parquet") for folder in (found, expected)]
    assert (files[0].read_bytes() == files[1].read_bytes()) == one_part
    assert pyarrow.parquet.read_metadata(files[0]).num_row_groups > 1 or one_part


def test_a_few_long_runs_are_prepared_in_blocks_that_come_in_parts(mgr, tmp_path):
    recording = write_drive(tmp_path / "monday", mgr, drive(mgr, runs=2, steps=900), "one_file")
    found = prepared(recording, mgr, tmp_path / "parts", 500)
    expected = prepared_whole(recording, mgr, tmp_path / "whole")
    assert_same(load_transitions(found), load_transitions(expected))
    assert load_preparation(found) == load_preparation(expected)


def with_velocity(robot):
    return robot.model_copy(update={"situation": ("command", "velocity")})


@pytest.mark.parametrize("rows", [1, 300, 10**6])
@pytest.mark.parametrize("given_velocity", [False, True])
def test_transitions_in_a_file_are_those_in_memory(recording, mgr, tmp_path, rows, given_velocity):
    robot = with_velocity(mgr) if given_velocity else mgr
    folder = prepared(recording, robot, tmp_path / "parts", rows)
    stored, loaded = stored_transitions(folder), load_transitions(folder)
    assert len(stored) == len(loaded)
    assert stored.digests() == loaded.digests()
    assert split_inputs(folder, stored) == split_inputs(folder, loaded)
    blocks = list(stored.blocks(array_fields()))
    for name in array_fields():
        np.testing.assert_array_equal(np.concatenate([block[name] for block in blocks]), getattr(loaded, name))
    for split in SPLITS:
        assert stored.count(split) == loaded.count(split) == len(loaded.part(split))
        assert_same(stored.part(split), loaded.part(split))
    assert_same(held_out(stored, ("validation", "test"), 60), held_out(loaded, ("validation", "test"), 60))
    assert not len(held_out(stored, (), 60))
    assert_same(stored.whole(), loaded)


@pytest.mark.parametrize("rows", [1, 300])
def test_tensors_filled_block_by_block_are_those_of_the_whole(recording, mgr, tmp_path, rows):
    folder = prepared(recording, mgr, tmp_path / "parts", rows)
    parts = ("command", "previous_command", "pose", "velocity", "elapsed_s", "duration_s", "neighbours")
    filled, loaded = tensor_splits(stored_transitions(folder), parts), load_transitions(folder)
    for split, (situation, displacement) in (("train", filled.train), ("validation", filled.validation)):
        own = loaded.part(split)
        np.testing.assert_array_equal(displacement.numpy(), own.displacement.astype(np.float32))
        np.testing.assert_array_equal(situation.elapsed_s.numpy(), own.time_s.astype(np.float32))
        for name in ("command", "previous_command", "pose", "velocity", "duration_s", "neighbours"):
            np.testing.assert_array_equal(getattr(situation, name).numpy(), getattr(own, name).astype(np.float32))
    assert filled.digest() == tensor_splits(loaded, parts).digest()


@pytest.mark.parametrize("place", [0.3, 0.5, 0.7])
def test_a_recording_damaged_in_the_middle_leaves_nothing(recording, mgr, tmp_path, place):
    file = recording / "runs.parquet"
    in_small_groups(file)
    flip(file, place)
    (tmp_path / "parts").mkdir()
    with pytest.raises(UserError) as refused:
        prepare(recording, mgr, SPLIT, tmp_path / "parts", rows_at_a_time=300)
    assert str(refused.value).startswith(f"{file}: no Parquet file can be read (")
    assert list((tmp_path / "parts").iterdir()) == []


def test_a_vehicle_that_does_not_drive_is_named_after_all_is_read(recording, mgr, tmp_path):
    (tmp_path / "parts").mkdir()
    with pytest.raises(UserError, match=rf"^{recording}: no vehicle '4': known: 1, 2, 3"):
        prepare(recording, mgr, SPLIT, tmp_path / "parts", ("4",), rows_at_a_time=300)
    assert list((tmp_path / "parts").iterdir()) == []


def test_of_long_runs_a_picture_shows_how_they_begin(mgr, tmp_path):
    recording = write_drive(tmp_path / "monday", mgr, drive(mgr, runs=2, steps=900), "one_file")
    stored = stored_transitions(prepared(recording, mgr, tmp_path / "parts", 500))
    figures = [Figure(), Figure()]
    for figure, most in zip(figures, (10**6, 12), strict=True):
        _draw_runs(figure.subplots(), stored, 30, most)
    shown, begun = ([line.get_xydata() for line in figure.axes[0].lines] for figure in figures)
    assert len(shown) == len(begun) == 2 * 30  # of each block and vehicle
    whole = load_transitions(stored.file.parent)
    assert sum(map(len, shown)) == (whole.run < 30).sum()
    for way, beginning in zip(shown, begun, strict=True):
        np.testing.assert_array_equal(beginning, way[:12])
    assert [figure.axes[0].get_title() for figure in figures] == ["the first 30 runs", "how the first 30 runs begin"]
