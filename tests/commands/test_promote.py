"""`swarmtwin promote`: a model becomes champion only by being measurably better, and the way back is open."""

import re

import numpy as np
import pytest
import yaml
from safetensors.numpy import load_file, save_file

from swarmtwin.dynamics.evaluation import predict
from swarmtwin.dynamics.model_folder import load_dynamics
from swarmtwin.recordings.reading import read_recording
from swarmtwin.tracking import registry
from swarmtwin.transitions import from_recording

NAME = "mgr-dynamics"
FIGURES = (
    r"one-step error (?P<change>[+-]\d+\.\d\d)% \(95 % interval (?P<low>[+-]\d+\.\d\d)% to (?P<high>[+-]\d+\.\d\d)%\)"
)


@pytest.fixture
def promote(swarmtwin):
    """Ask for promotion, measured on the other vehicle unless another recording is given."""

    def call(candidate, recording="other_vehicle"):
        return swarmtwin("promote", f"candidate={candidate}", f"recording={recording}")

    return call


def champion_number():
    champion = registry.champion(NAME)
    return champion and champion.number


def shuffle_weights(folder):
    """Make a model of equal size and scaling that has learned nothing."""
    rng = np.random.default_rng(1)
    weights = load_file(folder / "weights.safetensors")
    garbled = {name: rng.permutation(w.ravel()).reshape(w.shape) if w.ndim == 2 else w for name, w in weights.items()}
    save_file(garbled, folder / "weights.safetensors")
    return folder


def errors_by_hand(folder, recording, robot, runs=None):
    """Position and orientation errors of each transition of some runs."""
    transitions, _ = from_recording(read_recording(recording, robot))
    if runs is not None:
        transitions = transitions.where(np.isin(np.array(transitions.runs)[transitions.run], runs))
    residual = predict(load_dynamics(folder), transitions) - transitions.displacement
    return np.hypot(residual[:, 0], residual[:, 1]), abs(np.angle(np.exp(1j * residual[:, 2])))


def change_by_hand(candidate, incumbent):
    """Relative change of the mean errors in per cent, position and orientation alike."""
    return 50 * sum(c.mean() / i.mean() - 1 for c, i in zip(candidate, incumbent, strict=True))


def test_the_first_champion_must_beat_predicting_the_mean(promote, model):
    answer = promote(shuffle_weights(model("mlp", "garbled")))
    assert answer.status == 3
    assert re.fullmatch(
        rf"swarmtwin promote: {NAME} version 1 is not promoted: {FIGURES}: not measurably better than predicting the "
        r"mean displacement \(there is no champion yet\) on other_vehicle\n",
        answer.error,
    )
    assert champion_number() is None
    assert promote(model("mlp")).status == 0
    assert champion_number() == 2


def test_a_better_model_is_promoted_and_a_worse_one_is_not(promote, model, workshop, robots):
    rough, good = model("rough"), model("mlp")
    assert promote(rough).status == 0
    better = promote(good)
    assert better.status == 0
    assert champion_number() == 2
    worse = promote(rough)
    assert worse.status == 3
    assert champion_number() == 2
    assert re.fullmatch(
        rf"swarmtwin promote: {NAME} version 1 is not promoted: {FIGURES}: not measurably better than {NAME} version 2 "
        rf"on other_vehicle; {NAME} version 2 stays champion\n",
        worse.error,
    )
    errors = [errors_by_hand(folder, workshop / "other_vehicle", robots["mgr"]) for folder in (rough, good)]
    for answer, expected in ((better.shown, change_by_hand(*errors[::-1])), (worse.error, change_by_hand(*errors))):
        found = re.search(FIGURES, " ".join(answer.split()))
        assert float(found["change"]) == pytest.approx(expected, abs=0.006)
        assert float(found["low"]) < float(found["change"]) < float(found["high"])
    assert re.search(FIGURES, registry.champion(NAME).tags["promoted_because"])


def test_promoting_the_champion_again_changes_nothing(promote, model):
    folder = model("mlp")
    promote(folder)
    for candidate in (folder, 1, "challenger", f"models:/{NAME}@champion"):
        answer = promote(candidate)
        assert (answer.status, answer.shown) == (0, f"{NAME} version 1 is the champion already\n")
    assert len(registry.versions(NAME)) == 1


def test_rolling_back_restores_the_champion_before(promote, swarmtwin, model):
    promote(model("rough"))
    promote(model("mlp"))
    answer = swarmtwin("promote", "rollback=true")
    assert (answer.status, answer.shown) == (0, f"{NAME}: version 1 is champion again, version 2 no longer\n")
    assert champion_number() == 1
    answer = swarmtwin("promote", "rollback=true")
    assert answer.status == 2
    assert answer.error == f"swarmtwin promote: {NAME} version 1 is the first champion: there is none to roll back to\n"
    assert champion_number() == 1


@pytest.fixture
def with_test_runs(workshop, robots):
    """Plant which runs of the reference recording a model has not seen."""
    tracks = read_recording(workshop / "reference", robots["mgr"]).tracks

    def plant(folder, runs):
        description = yaml.safe_load((folder / "model.yaml").read_text())
        description["provenance"]["learned"] = [track.digest() for track in tracks if track.run not in runs]
        (folder / "model.yaml").write_text(yaml.safe_dump(description))
        return folder

    return plant


def test_on_their_own_recording_models_are_compared_on_what_neither_has_seen(
    promote, model, workshop, robots, with_test_runs
):
    runs = [f"run_{number:04d}" for number in range(1, 31)]
    rough, good = with_test_runs(model("rough"), runs[:10]), with_test_runs(model("mlp"), runs[4:14])
    assert promote(rough).status == 0
    answer = promote(good, "reference")
    assert answer.status == 0
    both = [errors_by_hand(folder, workshop / "reference", robots["mgr"], runs[4:10]) for folder in (good, rough)]
    found = re.search(FIGURES, " ".join(answer.shown.split()))
    assert float(found["change"]) == pytest.approx(change_by_hand(*both), abs=0.006)


def test_where_one_has_seen_every_run_there_is_no_comparison(promote, model, with_test_runs):
    runs = [f"run_{number:04d}" for number in range(1, 31)]
    promote(with_test_runs(model("rough"), runs[:8]))
    answer = promote(with_test_runs(model("mlp"), runs[8:14]), "reference")
    assert answer.status == 2
    assert answer.error == (
        f"swarmtwin promote: {NAME} version 2 and {NAME} version 1 were trained on recording 'reference', and no run "
        "of it is unseen by both: add recording=... with another one\n"
    )
    assert champion_number() == 1


@pytest.mark.parametrize(
    ("options", "message"),
    [
        (["candidate=7"], f"models:/{NAME}/7: no such version; there are 1 (@challenger) (@champion)"),
        (["candidate=models:/mur-dynamics/1"], f"no registered model 'mur-dynamics'; registered: {NAME}"),
        (["candidate=nowhere"], "no model folder nowhere: give a folder, models:/NAME@ALIAS or models:/NAME/VERSION"),
        (["candidate=rough", "robot=mur"], "rough is a model of robot 'mgr': add robot=mgr"),
        (["candidate=rough", "recording=elsewhere"], "no recording folder elsewhere"),
        (["rollback=true", "robot=mur"], "mur-dynamics has no champion to roll back from; there are none"),
    ],
)
def test_a_mistake_is_one_line_and_changes_nothing(promote, swarmtwin, model, options, message):
    promote(model("mlp"))
    model("rough")
    answer = swarmtwin("promote", "recording=other_vehicle", *options)
    assert answer.status == 2
    assert answer.error.startswith(f"swarmtwin promote: {message}")
    assert len(answer.error.strip().splitlines()) == 1
    assert champion_number() == 1
