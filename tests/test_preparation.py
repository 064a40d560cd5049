"""Splits by run, and the folder that keeps them."""

import dataclasses
import json

import numpy as np
import pyarrow.parquet
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from drives import drive, header_of
from swarmtwin.errors import UserError
from swarmtwin.recordings.recording import Recording
from swarmtwin.robot import Arena
from swarmtwin.transitions import (
    SPLITS,
    Fractions,
    from_recording,
    load_preparation,
    load_transitions,
    save_transitions,
    split_by_run,
)
from swarmtwin.transitions.preparation import describe, save_preparation

FRACTIONS = Fractions(train=0.85, validation=0.05, test=0.10)


@pytest.fixture(scope="module")
def recording(robots):
    mgr = robots["mgr"]
    tracks = drive(mgr, runs=40, steps=12, vehicles=("1", "02"))
    return Recording(mgr, header_of(mgr), tuple(tracks), {"duplicate_row": 2}, "0123abcd")


@pytest.fixture(scope="module")
def transitions(recording):
    return from_recording(recording)[0]


def of_sizes(transitions, sizes):
    """The first transitions of each run, so many that run k has `sizes[k]`."""
    position = np.arange(len(transitions)) - np.searchsorted(transitions.run, transitions.run)
    return transitions.where(position < np.append(sizes, np.zeros(40, int))[transitions.run])


# ---- splits


def test_a_run_is_in_one_split_only(transitions):
    split = split_by_run(transitions, FRACTIONS, seed=1)
    for run in range(40):
        assert len(set(split.split[split.run == run])) == 1


def test_shares_are_near_their_fractions(transitions):
    split = split_by_run(transitions, FRACTIONS, seed=1)
    shares = np.bincount(split.split) / len(split)
    np.testing.assert_allclose(shares, [0.85, 0.05, 0.10], atol=0.5 / 40)


def test_the_same_seed_splits_the_same_and_another_differently(transitions):
    first = split_by_run(transitions, FRACTIONS, seed=1)
    assert np.array_equal(first.split, split_by_run(transitions, FRACTIONS, seed=1).split)
    assert not np.array_equal(first.split, split_by_run(transitions, FRACTIONS, seed=2).split)


def test_splitting_changes_nothing_else(transitions):
    split = split_by_run(transitions, FRACTIONS, seed=1)
    assert dataclasses.replace(split, split=transitions.split) == transitions


@settings(max_examples=200, deadline=None, derandomize=True)
@given(sizes=st.lists(st.integers(1, 24), min_size=3, max_size=40), seed=st.integers(0, 2**32 - 1))
def test_every_split_has_a_run_whatever_the_runs_sizes(transitions, sizes, seed):
    few = of_sizes(transitions, sizes)
    split = split_by_run(few, FRACTIONS, seed)
    assert set(split.split) == {0, 1, 2}
    shares = np.bincount(split.split) / len(split)
    largest_run = max(sizes) / sum(sizes)
    assert abs(shares[1] - 0.05) <= max(largest_run, 0.05)
    assert abs(shares[2] - 0.10) <= max(largest_run, 0.10)


@pytest.mark.parametrize(
    ("runs", "fractions", "message"),
    [
        (
            2,
            FRACTIONS,
            "2 runs with transitions cannot be split into train, validation, test, at least one run each: "
            "record at least 3 runs, or set a fraction to 0",
        ),
        (
            1,
            Fractions(train=0.5, validation=0, test=0.5),
            "1 run with transitions cannot be split into train, test, at least one run each: "
            "record at least 2 runs, or set a fraction to 0",
        ),
    ],
)
def test_too_few_runs_are_an_error_that_says_how_many_are_needed(transitions, runs, fractions, message):
    with pytest.raises(UserError) as refused:
        split_by_run(of_sizes(transitions, [5] * runs), fractions, seed=1)
    assert str(refused.value) == message


def test_a_fraction_of_zero_leaves_a_split_empty(transitions):
    split = split_by_run(of_sizes(transitions, [5]), Fractions(train=1, validation=0, test=0), seed=1)
    assert set(split.split) == {SPLITS.index("train")}


def test_fractions_must_sum_to_one():
    with pytest.raises(
        UserError, match=r"^here: field 'content': .* train, validation and test must sum to 1, not 1.1"
    ):
        Fractions.parse({"train": 0.9, "validation": 0.1, "test": 0.1}, "here")


# ---- the folder


def test_transitions_are_loaded_as_they_were_saved(transitions, tmp_path):
    split = split_by_run(transitions, FRACTIONS, seed=1)
    save_transitions(tmp_path, split)
    loaded = load_transitions(tmp_path)
    for field in dataclasses.fields(split):
        saved, found = getattr(split, field.name), getattr(loaded, field.name)
        if isinstance(saved, np.ndarray):
            assert found.dtype.kind == saved.dtype.kind
            np.testing.assert_array_equal(found, saved, err_msg=field.name)
        else:
            assert found == saved


def test_a_file_of_an_old_version_has_no_earlier_commands(transitions, tmp_path):
    save_transitions(tmp_path, transitions)
    file = tmp_path / "transitions.parquet"
    table = pyarrow.parquet.read_table(file)
    np.testing.assert_array_equal(table.column("earlier_right").to_numpy(), transitions.earlier_command[:, 1])
    assert np.isfinite(transitions.earlier_command).any()
    pyarrow.parquet.write_table(table.drop_columns(["earlier_left", "earlier_right"]), file)
    loaded = load_transitions(tmp_path)
    assert loaded.earlier_command.shape == transitions.command.shape
    assert np.isnan(loaded.earlier_command).all()
    np.testing.assert_array_equal(loaded.previous_command, transitions.previous_command)


def with_momentum(transitions):
    robot = transitions.robot.model_copy(update={"situation": ("command", "velocity")})
    return dataclasses.replace(transitions, robot=robot)


def test_velocities_are_written_where_the_robot_s_models_are_given_them(transitions, tmp_path):
    """And nothing else changes: files and digests of other robots are those of earlier versions."""
    columns = ("velocity_forward_mm_s", "velocity_left_mm_s", "velocity_turn_rad_s")
    names = {}
    for name, written in {"without": transitions, "with": with_momentum(transitions)}.items():
        (tmp_path / name).mkdir()
        save_transitions(tmp_path / name, written)
        names[name] = pyarrow.parquet.read_schema(tmp_path / name / "transitions.parquet").names
        np.testing.assert_array_equal(load_transitions(tmp_path / name).velocity, transitions.velocity)
    assert set(names["with"]) - set(names["without"]) == set(columns)
    assert np.isfinite(transitions.velocity).any()
    halved = {"velocity": transitions.velocity / 2}
    assert dataclasses.replace(transitions, **halved).digest() == transitions.digest()
    assert dataclasses.replace(with_momentum(transitions), **halved).digest() != with_momentum(transitions).digest()


def test_a_file_of_an_old_version_has_the_velocities_of_its_transitions(transitions, tmp_path):
    """A robot's file may have come to state velocity since."""
    save_transitions(tmp_path, with_momentum(transitions))
    file = tmp_path / "transitions.parquet"
    table = pyarrow.parquet.read_table(file)
    own = [name for name in table.column_names if name.startswith("velocity_")]
    np.testing.assert_array_equal(table.column(own[2]).to_numpy(), transitions.velocity[:, 2])
    pyarrow.parquet.write_table(table.drop_columns(own), file)
    np.testing.assert_array_equal(load_transitions(tmp_path).velocity, transitions.velocity)


def test_the_arena_is_the_recording_s_own(recording, tmp_path):
    own = Arena(x=(-20, 1400), y=(0, 1200))
    moved = dataclasses.replace(recording, header=recording.header.model_copy(update={"arena_mm": own}))
    transitions, counts = from_recording(moved)
    split = split_by_run(transitions, FRACTIONS, seed=1)
    save_preparation(tmp_path, split, describe(moved, "monday", split, counts, FRACTIONS, seed=1))
    assert load_transitions(tmp_path).arena_mm == load_preparation(tmp_path).arena_mm == own


def test_a_folder_of_an_old_version_has_the_robot_s_usual_arena(transitions, tmp_path):
    save_transitions(tmp_path, transitions)
    file = tmp_path / "transitions.parquet"
    table = pyarrow.parquet.read_table(file)
    metadata = {name: value for name, value in table.schema.metadata.items() if name != b"arena_mm"}
    pyarrow.parquet.write_table(table.replace_schema_metadata(metadata), file)
    assert load_transitions(tmp_path).arena_mm == transitions.robot.arena_mm


def test_runs_without_transitions_keep_their_place(transitions, tmp_path):
    save_transitions(tmp_path, few := of_sizes(transitions, [3, 0, 4]))
    loaded = load_transitions(tmp_path)
    assert loaded.runs == few.runs
    assert sorted(set(loaded.run)) == [0, 2]


def test_the_preparation_tells_where_transitions_come_from(recording, transitions, tmp_path):
    _, counts = from_recording(recording)
    split = split_by_run(transitions, FRACTIONS, seed=1)
    save_preparation(tmp_path, split, describe(recording, "monday", split, counts, FRACTIONS, seed=1))
    preparation = load_preparation(tmp_path)
    assert (preparation.robot, preparation.recording, preparation.digest) == ("mgr", "monday", "0123abcd")
    assert (preparation.vehicles, preparation.seed, preparation.fractions) == (("02", "1"), 1, FRACTIONS)
    assert preparation.counts.model_dump() == dataclasses.asdict(counts)
    assert sorted(run for runs in preparation.runs.values() for run in runs) == list(recording.runs)
    assert sum(preparation.transitions.values()) == counts.kept


@pytest.mark.parametrize("load", [load_transitions, load_preparation])
def test_a_folder_without_the_files_is_refused(load, tmp_path):
    with pytest.raises(UserError, match=r"(parquet|json) is missing: name a folder that swarmtwin prepare made$"):
        load(tmp_path)


def test_damaged_transitions_are_refused(transitions, tmp_path):
    save_transitions(tmp_path, transitions)
    file = tmp_path / "transitions.parquet"
    file.write_bytes(file.read_bytes()[:-50])
    with pytest.raises(UserError) as refused:
        load_transitions(tmp_path)
    assert str(refused.value).startswith(f"{file}: no transitions can be read (")
    assert str(refused.value).endswith("): make it again with swarmtwin prepare")


def test_a_damaged_preparation_is_refused(tmp_path):
    (tmp_path / "preparation.json").write_text('{"robot": "mgr"')
    with pytest.raises(
        UserError, match=r"preparation.json: not valid JSON \(.*\): make it again with swarmtwin prepare$"
    ):
        load_preparation(tmp_path)
    (tmp_path / "preparation.json").write_text(json.dumps({"robot": "mgr"}))
    with pytest.raises(UserError, match=r"preparation\.json: field 'recording': Field required"):
        load_preparation(tmp_path)
