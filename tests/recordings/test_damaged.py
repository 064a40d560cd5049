"""Whatever happens to a recording's files: one clear error, or exactly the transitions that were not touched."""

import shutil
import tempfile
from pathlib import Path

import numpy as np
import pytest
from damage import csv_damage, mingled_csv_damage, parquet_damage
from hypothesis import given, settings

from drives import drive, write_drive
from swarmtwin.errors import UserError
from swarmtwin.recordings.reading import read_recording
from swarmtwin.transitions import from_recording

STEPS, RUNS, VEHICLES = 14, 2, ("1", "2")


class Clean:
    """A clean recording of the MGR: its folder, and its transitions by run, vehicle and time."""

    def __init__(self, folder, robot, file_format):
        self.folder = write_drive(folder, robot, drive(robot, RUNS, STEPS, VEHICLES), file_format)
        self.robot = robot
        self.transitions = by_key(from_recording(read_recording(folder, robot))[0])


@pytest.fixture(scope="module")
def clean_csv(robots, tmp_path_factory):
    return Clean(tmp_path_factory.mktemp("clean") / "recording", robots["mgr"], "csv")


@pytest.fixture(scope="module")
def clean_parquet(robots, tmp_path_factory):
    return Clean(tmp_path_factory.mktemp("clean") / "recording", robots["mgr"], "parquet")


def by_key(transitions):
    """Everything known of each transition, by run, vehicle and time: its values, and the commands before."""
    values = np.column_stack([transitions.command, transitions.pose, transitions.displacement, transitions.duration_s])
    runs = [transitions.runs[index] for index in transitions.run]
    vehicles = [transitions.vehicles[index] for index in transitions.vehicle]
    keys = zip(runs, vehicles, transitions.time_s.tolist(), strict=True)
    before = np.stack([transitions.previous_command, transitions.earlier_command], axis=1)
    return dict(zip(keys, zip(values, before, strict=True), strict=True))


def attempt(folder, robot):
    """Return the recording and no refusal, or no recording and the message that refused it."""
    try:
        return read_recording(folder, robot), None
    except UserError as error:
        return None, str(error)


def assert_refused_or_true(clean, damages):
    """Damage a copy of the clean recording and read it.

    Either it is refused by an error of one line that begins with the faulty file, or every transition read is, number
    by number, one of the clean recording's, none of an untouched run is missing, and all pairs are accounted for.
    """
    with tempfile.TemporaryDirectory() as scratch:
        copy = Path(scratch) / "recording"
        shutil.copytree(clean.folder, copy)
        for damage in damages:
            damage(copy)
        recording, refusal = attempt(copy, clean.robot)
        if refusal is not None:
            assert refusal.startswith(str(copy))
            assert "\n" not in refusal
            return
    transitions, counts = from_recording(recording)
    found = by_key(transitions)
    touched = {f"run_{damage.run:05d}" for damage in damages if damage.run is not None}
    assert {key for key in clean.transitions if key[0] not in touched} <= set(found)
    for key, (values, before) in found.items():
        true_values, true_before = clean.transitions[key]
        assert np.array_equal(values, true_values), key
        for command, true_command in zip(before, true_before, strict=True):
            assert np.isnan(command).all() or np.array_equal(command, true_command), key
    assert counts.considered == counts.kept + sum(counts.dropped.values())
    assert counts.kept == len(transitions)


@settings(max_examples=500, deadline=None, derandomize=True)
@given(damage=csv_damage)
def test_damaged_csv_is_refused_or_read_without_a_wrong_transition(clean_csv, damage):
    assert_refused_or_true(clean_csv, [damage])


@settings(max_examples=200, deadline=None, derandomize=True)
@given(damages=mingled_csv_damage)
def test_csv_damaged_in_several_ways_is_refused_or_read_without_a_wrong_transition(clean_csv, damages):
    assert_refused_or_true(clean_csv, damages)


@settings(max_examples=200, deadline=None, derandomize=True)
@given(damage=parquet_damage)
def test_damaged_parquet_is_refused_or_read_without_a_wrong_transition(clean_parquet, damage):
    assert_refused_or_true(clean_parquet, [damage])
