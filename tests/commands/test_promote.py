"""`swarmtwin promote`: a model becomes champion only by being measurably better, and the way back is open."""

import re

import mlflow
import numpy as np
import pytest
import yaml

from swarmtwin.dynamics.evaluation import one_step, predict
from swarmtwin.dynamics.model_folder import load_dynamics, load_evidence, save_dynamics
from swarmtwin.dynamics.plain_baseline import fit_kinematics
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
    champion = registry.holder(NAME, "champion")
    return champion and champion.number


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


@pytest.fixture
def knowing(model, workshop, robots):
    """A model that no recording of another vehicle could give: it knows how the other vehicle moves."""
    folder, robot = model("mlp", "knowing"), robots["mgr"]
    description = yaml.safe_load((folder / "model.yaml").read_text())
    transitions, _ = from_recording(read_recording(workshop / "other_vehicle", robot))
    save_dynamics(folder, fit_kinematics(transitions), description["provenance"])
    return folder


def test_the_plain_baseline_is_the_kinematic_model_and_fits_at_least_as_well_as_a_trained_one(library):
    trained = library / "models" / "kinematic"
    validation = load_evidence(trained).part("validation")
    fitted, other = (one_step(each, validation) for each in (fit_kinematics(validation), load_dynamics(trained)))
    assert fitted.position_mm + fitted.orientation_deg <= other.position_mm + other.orientation_deg


def test_the_first_champion_must_beat_the_kinematic_model(promote, swarmtwin, model, knowing):
    plain = promote(model("kinematic"))
    assert plain.status == 3
    assert re.fullmatch(
        rf"swarmtwin promote: {NAME} version 1 is not promoted: {FIGURES}: not measurably better than the kinematic "
        r"model fitted to its validation runs \(there is no champion yet\) on other_vehicle\n",
        plain.error,
    )
    assert promote(model("mlp")).status == 3
    assert swarmtwin("prepare", "recording=reference", "output=prepared").status == 0
    fuller = swarmtwin("promote", f"candidate={knowing}", "recording=other_vehicle", "baseline=prepared")
    assert fuller.status == 0
    assert re.search(rf"{FIGURES}: measurably better than the kinematic model fitted to prepared ", fuller.shown)
    assert champion_number() == 3


def test_what_a_plain_baseline_would_be_fitted_to_is_asked_for_and_is_not_what_is_judged_on(swarmtwin, model):
    (model("mlp") / "evidence.parquet").unlink()
    ask = ("promote", "candidate=mlp", "recording=other_vehicle")
    answer = swarmtwin(*ask)
    assert answer.status == 2
    assert (
        "carries no measured transitions to fit the kinematic model to, the rival of a first champion" in answer.error
    )
    assert swarmtwin("prepare", "recording=other_vehicle", "output=judged").status == 0
    answer = swarmtwin(*ask, "baseline=judged")
    assert answer.status == 2
    assert "baseline judged holds runs that are judged on: add recording=... with another one" in answer.error
    assert champion_number() is None


def test_a_better_model_is_promoted_and_a_worse_one_is_not(promote, model, workshop, robots, crown):
    rough, good = model("rough"), model("mlp")
    crown(rough)
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
    assert re.search(FIGURES, registry.holder(NAME, "champion").tags["promoted_because"])


def test_the_page_of_a_champion_says_what_it_was_measured_on_against_whom_and_how_sure_that_is(
    promote, swarmtwin, model, workshop, robots, crown
):
    rough, good = model("rough"), model("mlp")
    crown(rough)
    assert promote(good).status == 0
    errors = [errors_by_hand(folder, workshop / "other_vehicle", robots["mgr"]) for folder in (good, rough)]
    because, _, *lines = page_of(2).splitlines()[:6]
    found = re.fullmatch(
        r"A dynamics model of robot `mgr`, `mlp`, trained on real transitions\. It became champion because its "
        r"one-step error is (?P<gain>\S+)% smaller \(95 % interval (?P<least>\S+)% to (?P<most>\S+)% smaller\) "
        rf"than that of {NAME} version 1\.",
        because,
    )
    assert float(found["gain"]) == pytest.approx(-change_by_hand(*errors), abs=0.06)
    assert float(found["least"]) < float(found["gain"]) < float(found["most"])
    recording = read_recording(workshop / "other_vehicle", robots["mgr"])
    assert lines[:3] == [
        f"- **Measured on** 10 runs, {len(errors[0][0])} transitions, of the recording `other_vehicle`, of which "
        f"neither model has seen any (its source: {recording.header.source}).",
        f"- **Compared with** {NAME} version 1, the champion before it.",
        f"- **Promoted by** `swarmtwin promote candidate={good} recording=other_vehicle`",
    ]
    assert lines[3].startswith(f"- **Made by** [the run `register {good}`](#/experiments/")
    assert page_of(1) is None


def test_the_page_of_the_first_champion_shows_what_was_drawn_when_it_was_trained(promote, knowing):
    (knowing / "history.png").write_bytes(b"drawn")
    assert promote(knowing).status == 0
    page = page_of(1)
    assert "**Compared with** the kinematic model fitted to its validation runs: there was no champion" in page
    assert f"![history.png](model-versions/get-artifact?name={NAME}&version=1&path=data%2Fmodel%2Fhistory.png)" in page


def page_of(number):
    return mlflow.MlflowClient().get_model_version(NAME, str(number)).description


def test_promoting_the_champion_again_changes_nothing(promote, model, crown):
    folder = model("mlp")
    registry.challenge(crown(folder), None)
    for candidate in (folder, 1, "challenger", f"models:/{NAME}@champion"):
        answer = promote(candidate)
        assert (answer.status, answer.shown) == (0, f"{NAME} version 1 is the champion already\n")
    assert len(registry.versions(NAME)) == 1


def test_rolling_back_restores_the_champion_before(swarmtwin, model, crown):
    crown(model("rough"))
    crown(model("mlp"))
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
    promote, model, workshop, robots, with_test_runs, crown
):
    runs = [f"run_{number:04d}" for number in range(1, 31)]
    rough, good = with_test_runs(model("rough"), runs[:10]), with_test_runs(model("mlp"), runs[4:14])
    crown(rough)
    answer = promote(good, "reference")
    assert answer.status == 0
    both = [errors_by_hand(folder, workshop / "reference", robots["mgr"], runs[4:10]) for folder in (good, rough)]
    found = re.search(FIGURES, " ".join(answer.shown.split()))
    assert float(found["change"]) == pytest.approx(change_by_hand(*both), abs=0.006)


def test_where_one_has_seen_every_run_there_is_no_comparison(promote, model, with_test_runs, crown):
    runs = [f"run_{number:04d}" for number in range(1, 31)]
    crown(with_test_runs(model("rough"), runs[:8]))
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
        (["candidate=7"], f"models:/{NAME}/7: no such version; there are 1 (@champion)"),
        (["candidate=challenger"], f"models:/{NAME}@challenger: no such version; there are 1 (@champion)"),
        (["task=collective"], "task=... is of policies: leave it out, or add what=policy"),
        (["rollback=true", "task=collective"], "task=... is of policies: leave it out, or add what=policy"),
        (["candidate=models:/mur-dynamics/1"], f"no registered model 'mur-dynamics'; registered: {NAME}"),
        (["candidate=nowhere"], "no model folder nowhere: give a folder, models:/NAME@ALIAS or models:/NAME/VERSION"),
        (["candidate=rough", "robot=mur"], "rough is a model of robot 'mgr': add robot=mgr"),
        (["candidate=rough", "recording=elsewhere"], "no recording folder elsewhere"),
        (["rollback=true", "robot=mur"], "mur-dynamics has no champion to roll back from; there are none"),
    ],
)
def test_a_mistake_is_one_line_and_changes_nothing(swarmtwin, model, options, message, crown):
    crown(model("mlp"))
    model("rough")
    answer = swarmtwin("promote", "recording=other_vehicle", *options)
    assert answer.status == 2
    assert answer.error.startswith(f"swarmtwin promote: {message}")
    assert len(answer.error.strip().splitlines()) == 1
    assert champion_number() == 1
