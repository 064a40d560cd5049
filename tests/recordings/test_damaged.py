"""Whatever happens to a recording's files: one clear error, or exactly the transitions that were not touched."""

import shutil
import tempfile
from pathlib import Path

import numpy as np
import pytest
from damage import csv_damage, parquet_damage
from drives import drive, write_drive
from hypothesis import given, settings
from hypothesis import strategies as st

from swarmtwin.errors import UserError
from swarmtwin.recordings.reading import read_recording
from swarmtwin.transitions import from_recording

STEPS, RUNS, VEHICLES = 14, 2, ("1", "2")


@pytest.fixture(scope="module", params=["csv", "parquet"])
def clean(request, robots, tmp_path_factory):
    """A clean recording of the MGR: its folder, and its transitions by run, vehicle and time."""
    folder = tmp_path_factory.mktemp("clean") / "recording"
    write_drive(folder, robots["mgr"], drive(robots["mgr"], RUNS, STEPS, VEHICLES), request.param)
    return folder, by_key(from_recording(read_recording(folder, robots["mgr"]))[0])


def by_key(transitions):
    """Everything known of each transition, by run, vehicle and time."""
    return {
        (
            transitions.runs[transitions.run[index]],
            transitions.vehicles[transitions.vehicle[index]],
            transitions.time_s[index],
        ): (
            np.concatenate(
                [transitions.command[index], transitions.pose[index], transitions.displacement[index]]
                + [transitions.duration_s[index : index + 1]]
            ),
            transitions.previous_command[index],
        )
        for index in range(len(transitions))
    }


def read_damaged(folder, robot, damages):
    """Damage a copy of the recording; return its transitions and counts, or the error, which names a file of it."""
    with tempfile.TemporaryDirectory() as scratch:
        copy = Path(scratch) / "recording"
        shutil.copytree(folder, copy)
        for damage in damages:
            damage(copy)
        try:
            recording = read_recording(copy, robot)
        except UserError as error:
            assert str(error).startswith(str(copy))
            assert "\n" not in str(error)
            return None
        return from_recording(recording)


def assert_nothing_wrong(result, clean_transitions):
    """Check that each transition is one of the clean ones, and that no clean one is missing without being counted."""
    transitions, counts = result
    kept = by_key(transitions)
    for key, (values, previous_command) in kept.items():
        clean_values, clean_previous = clean_transitions[key]
        assert np.array_equal(values, clean_values)
        assert np.isnan(previous_command).all() or np.array_equal(previous_command, clean_previous)
    assert counts.considered == counts.kept + sum(counts.dropped.values())
    assert counts.kept == len(kept)


@pytest.mark.parametrize("clean", ["csv"], indirect=True)
@settings(max_examples=500, deadline=None, derandomize=True)
@given(damages=st.lists(csv_damage, min_size=1, max_size=2))
def test_damaged_csv_is_refused_or_read_without_a_wrong_transition(clean, robots, damages):
    folder, clean_transitions = clean
    if result := read_damaged(folder, robots["mgr"], damages):
        assert_nothing_wrong(result, clean_transitions)


@pytest.mark.parametrize("clean", ["parquet"], indirect=True)
@settings(max_examples=200, deadline=None, derandomize=True)
@given(damage=parquet_damage)
def test_damaged_parquet_is_refused_or_read_without_a_wrong_transition(clean, robots, damage):
    folder, clean_transitions = clean
    if result := read_damaged(folder, robots["mgr"], [damage]):
        assert_nothing_wrong(result, clean_transitions)
