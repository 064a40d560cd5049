"""What a model has not seen: the test runs of its own recording, other vehicles, other recordings."""

import dataclasses

import numpy as np
import pytest
import yaml

from drives import drive, header_of
from swarmtwin.dynamics.model_config import model_config
from swarmtwin.dynamics.model_folder import save_dynamics
from swarmtwin.dynamics.provenance import Provenance, SeedOutcome
from swarmtwin.dynamics.training import train
from swarmtwin.errors import UserError
from swarmtwin.recordings.recording import Recording
from swarmtwin.transitions import from_recording, split_by_run
from swarmtwin.transitions.preparation import describe
from swarmtwin.transitions.splitting import Fractions
from toy import CONF, recipe, toy_transitions

LIVE = SeedOutcome(seed=4, best_epoch=2, position_mm=3.2, orientation_deg=3.9, dead=None)
DIVERGED = SeedOutcome(seed=3, best_epoch=0, position_mm=None, orientation_deg=None, dead="not finite in epoch 1")


@pytest.fixture
def recording(robots):
    """Ten runs of vehicles 1 and 2."""
    tracks = tuple(drive(robots["mgr"], runs=10))
    return Recording(robots["mgr"], header_of(robots["mgr"]), tracks, digest="monday")


def origin(recording, vehicles, test=0.2):
    """Where a model comes from that some vehicles of a recording taught."""
    seen = recording.where(lambda track: track.vehicle in vehicles)
    transitions, counts = from_recording(seen)
    fractions = Fractions(train=0.9 - test, validation=0.1, test=test)
    preparation = describe(seen, "monday", split_by_run(transitions, fractions, 1), counts, fractions, 1)
    return Provenance.of(preparation, {"name": "fast"}, 4, (DIVERGED, LIVE))


def test_of_its_own_recording_only_test_runs_are_unseen(recording):
    provenance = origin(recording, ("1", "2"))
    assert len(provenance.runs["test"]) == 2
    unseen = provenance.unseen_part(recording)
    assert {(track.run, track.vehicle) for track in unseen.tracks} == {
        (run, vehicle) for run in provenance.runs["test"] for vehicle in ("1", "2")
    }


def test_every_transition_is_either_seen_or_unseen(recording):
    provenance = origin(recording, ("1", "2"))
    everything, _ = from_recording(recording)
    unseen, _ = from_recording(provenance.unseen_part(recording))
    runs = np.array(everything.runs)[everything.run]
    seen = np.isin(runs, [*provenance.runs["train"], *provenance.runs["validation"]])
    assert len(unseen) == (~seen).sum() > 0
    np.testing.assert_array_equal(unseen.displacement, everything.displacement[~seen])


def test_a_vehicle_that_taught_nothing_is_unseen_in_all_its_runs(recording):
    unseen = origin(recording, ("1",)).unseen_part(recording)
    by_vehicle = {vehicle: sum(track.vehicle == vehicle for track in unseen.tracks) for vehicle in ("1", "2")}
    assert by_vehicle == {"1": 2, "2": 10}


def test_another_recording_is_unseen_though_its_runs_are_called_the_same(recording):
    tracks = tuple(dataclasses.replace(track, pose=track.pose + np.array([1, 0, 0])) for track in recording.tracks)
    tuesday = dataclasses.replace(recording, tracks=tracks)
    assert origin(recording, ("1", "2")).unseen_part(tuesday) is tuesday


def test_a_renamed_part_of_its_recording_is_recognised(recording):
    provenance = origin(recording, ("1", "2"))
    left_out = provenance.runs["train"][0]
    tracks = [track for track in recording.tracks if track.run != left_out]
    copies = tuple(dataclasses.replace(track, run=f"copy_{track.run}") for track in tracks)
    part = dataclasses.replace(recording, tracks=copies, digest="another file")
    unseen = {track.run.removeprefix("copy_") for track in provenance.unseen_part(part).tracks}
    assert unseen == set(provenance.runs["test"])


def test_who_saw_everything_cannot_be_measured(recording):
    with pytest.raises(UserError) as refused:
        origin(recording, ("1", "2"), test=0).unseen_part(recording)
    assert str(refused.value) == (
        "the model was trained on every run of recording 'monday': "
        "evaluate on another recording, or train with a test fraction above 0"
    )


def test_the_chosen_seed_has_errors_and_one_that_diverged_has_none(recording):
    provenance = origin(recording, ("1",))
    assert provenance.chosen == LIVE
    assert provenance.chosen.errors == {"position_mm": 3.2, "orientation_deg": 3.9}
    assert DIVERGED.errors == {}


@pytest.fixture
def folder(robots, recording, tmp_path):
    """A saved model that knows where it comes from."""
    config = model_config(yaml.safe_load((CONF / "model" / "kinematic.yaml").read_text()), "model")
    trained = train(toy_transitions(robots["mgr"], 300), config, recipe(epochs=1), [1])
    save_dynamics(tmp_path, trained.dynamics, origin(recording, ("1",)).model_dump(mode="json"))
    return tmp_path


def test_what_is_written_is_read(folder, recording):
    assert Provenance.read(folder) == origin(recording, ("1",))


def test_a_damaged_description_names_file_and_field(folder):
    content = yaml.safe_load((folder / "model.yaml").read_text())
    content["provenance"]["sed"] = content["provenance"].pop("seed")
    (folder / "model.yaml").write_text(yaml.safe_dump(content))
    with pytest.raises(UserError) as refused:
        Provenance.read(folder)
    assert str(refused.value).startswith(f"{folder / 'model.yaml'}: provenance: field 'seed': Field required")
