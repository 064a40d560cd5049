"""Of a simulation's own recording what it was not fitted to counts, however its runs are called."""

import dataclasses
from pathlib import Path

import numpy as np
import pytest

from drives import drive, header_of
from swarmtwin.diagnosis.reference_inputs import _not_fitted
from swarmtwin.dynamics.model_folder import save_evidence
from swarmtwin.dynamics.provenance import Provenance, SeedOutcome
from swarmtwin.errors import UserError
from swarmtwin.recordings.blocks import in_blocks
from swarmtwin.recordings.joining import joined
from swarmtwin.recordings.recording import Recording
from swarmtwin.transitions import from_recording, split_by_run
from swarmtwin.transitions.preparation import describe
from swarmtwin.transitions.splitting import Fractions

FRACTIONS = Fractions(train=0.6, validation=0.2, test=0.2)
OUTCOME = SeedOutcome(seed=4, best_epoch=2, position_mm=3.2, orientation_deg=3.9, dead=None)


@pytest.fixture
def trained(robots, tmp_path):
    """A recording of ten runs of one vehicle, where a simulation comes from that it taught, and that one's folder."""
    return trained_on(robots["mgr"], drive(robots["mgr"], runs=10, vehicles=("1",)), tmp_path)


def trained_on(robot, tracks, folder):
    recording = Recording(robot, header_of(robot), tuple(tracks), digest="monday")
    transitions, counts = from_recording(recording)
    split = split_by_run(transitions, FRACTIONS, 1)
    preparation = describe(recording, "monday", split, counts, FRACTIONS, 1)
    save_evidence(folder, split.where(split.split != 0))
    return recording, Provenance.of(preparation, {"name": "fast"}, 4, (OUTCOME,)), folder


def test_runs_that_it_was_only_chosen_by_count_however_they_are_called(robots, trained):
    recording, provenance, folder = trained
    counting = {*provenance.runs["validation"], *provenance.runs["test"]}
    assert set(_not_fitted(recording, folder, provenance).runs) == counting
    # a copy, its runs numbered anew, so that runs that were fitted to bear the names of those that were not
    names = dict(zip(recording.runs, recording.runs[::-1], strict=True))
    copies = tuple(dataclasses.replace(track, run=names[track.run]) for track in recording.tracks)
    copy = dataclasses.replace(recording, tracks=copies)
    assert set(_not_fitted(copy, folder, provenance).runs) == {names[run] for run in counting}
    # beside another recording
    moved = tuple(dataclasses.replace(track, pose=track.pose + np.array([1, 0, 0])) for track in recording.tracks)
    both = joined({Path("one"): recording, Path("two"): dataclasses.replace(recording, tracks=moved, digest="tuesday")})
    expected = {f"one_{run}" for run in counting} | {f"two_{run}" for run in recording.runs}
    assert set(_not_fitted(both, folder, provenance).runs) == expected


def test_a_recording_that_it_was_fitted_to_altogether_is_refused(trained):
    recording, provenance, folder = trained
    fitted = recording.where(lambda track: track.run in provenance.runs["train"])
    with pytest.raises(UserError, match="trained on every run"):
        _not_fitted(fitted, folder, provenance)


def test_of_a_copy_that_is_cut_elsewhere_hardly_anything_counts_that_was_fitted_to(robots, tmp_path):
    runs = drive(robots["mgr"], runs=4, steps=640, vehicles=("1",))
    recording, provenance, folder = trained_on(robots["mgr"], in_blocks(runs), tmp_path)
    fitted, _ = from_recording(recording.where(lambda track: track.run in provenance.runs["train"]))
    copy = dataclasses.replace(recording, tracks=in_blocks(runs[:3]))
    assert (len(recording.runs), len(copy.runs)) == (40, 42)
    counting, _ = from_recording(_not_fitted(copy, folder, provenance))
    is_fitted = np.isin(counting.time_s, fitted.time_s) & np.isin(counting.pose[:, 0], fitted.pose[:, 0])
    assert len(counting) > 100
    assert is_fitted.mean() < 0.1
