"""`swarmtwin diagnose`: both fixed calls, what they leave, and one clear message where nothing can be concluded."""

import json
import shutil

import mlflow
import numpy as np
import pandas as pd
import pytest

from swarmtwin.commands.app import run_command
from swarmtwin.diagnosis import extension
from swarmtwin.diagnosis.reference import Reference
from swarmtwin.diagnosis.report.sentences import verdict_words
from swarmtwin.diagnosis.saved_diagnosis import read_result
from swarmtwin.diagnosis.settings import VerdictSettings
from swarmtwin.dynamics.evaluation import predict
from swarmtwin.dynamics.provenance import Provenance
from swarmtwin.recordings.reading import read_recording
from swarmtwin.simulation.simulation_folder import load_simulation
from swarmtwin.standin.physics import Physics
from swarmtwin.tracking.registry import versions
from swarmtwin.transitions import from_recording
from swarmtwin.transitions.storage import write_transitions
from tiny_policies import robot_named

SAG = "effects=[{name: battery_sag, loss: 0.35}]"
QUICK = ("diagnosis.reference.folds=3", "diagnosis.search.most_causes=2")


def call(*arguments, expected=0):
    """Run a command in this process; return its exit status, which must be the one expected."""
    status = run_command(arguments[0], [str(argument) for argument in arguments[1:]])
    assert status == expected
    return status


@pytest.fixture(scope="module")
def drives(tmp_path_factory):
    """Recordings of the ground robot, clean, ageing and short, in a folder with its own MLflow store."""
    folder = tmp_path_factory.mktemp("drives")
    record = ("record", "robot=mgr", "steps=30")
    with pytest.MonkeyPatch.context() as patch:
        patch.chdir(folder)
        patch.delenv("MLFLOW_TRACKING_URI", raising=False)
        patch.setattr(Physics, "bank_rows", 4096)
        call(*record, "runs=40", "seed=3", f"output={folder / 'reference'}")
        call(*record, "runs=40", "seed=4", SAG, f"output={folder / 'sag'}")
        call(*record, "runs=40", "seed=6", f"output={folder / 'clean'}")
        call(*record, "runs=5", "seed=5", f"output={folder / 'short'}")
        yield folder


@pytest.fixture(scope="module")
def diagnosed(drives):
    """The diagnosis of the ageing session against the clean recording."""
    output = drives / "diagnosis"
    given = (f"reference={drives / 'reference'}", f"measured={drives / 'sag'}")
    call("diagnose", "robot=mgr", *given, *QUICK, f"output={output}")
    return output


def test_an_ageing_battery_is_named_with_its_loss(diagnosed):
    diagnosis = json.loads((diagnosed / "diagnosis.json").read_text())
    assert diagnosis["verdict"] == "explained"
    assert [cause["name"] for cause in diagnosis["causes"]] == ["battery_sag"]
    loss = diagnosis["causes"][0]["parameters"]["loss"]
    assert loss["low"] < 0.35 < loss["high"]
    assert loss["high"] - loss["low"] < 0.14
    gain = diagnosis["gain"]["position_mm"]
    assert gain["after"] < gain["before"]
    assert 0 < gain["low"] < gain["high"]


def test_what_the_cause_gains_in_open_loop_over_seconds_is_told_as_far_as_runs_are_long(diagnosed):
    found = read_result(diagnosed).gain.open_loop_windows
    assert [(one.window_s, one.pieces, one.runs) for one in found] == [(2.0, 70, 10), (5.0, 30, 10), (10.0, 10, 10)]
    assert all(one.low < one.before - one.after < one.high and one.after < one.before for one in found)
    assert found[0].low > 0  # of the longer ones there are few pieces
    assert found[0].before < found[1].before < found[2].before
    (run,) = mlflow.search_runs(
        experiment_names=["swarmtwin/diagnosis"], filter_string=f"params.output = '{diagnosed}'", output_format="list"
    )
    assert run.data.metrics["after_open_loop_10s_mm"] == found[2].after


def test_the_extended_simulation_is_a_dynamics_model_like_any_other(drives, diagnosed):
    extended = load_simulation(diagnosed / "simulation")
    transitions, _ = from_recording(read_recording(drives / "sag", extended.robot))
    predicted = predict(extended, transitions)
    assert predicted.shape == (len(transitions), 3)
    version = versions("mgr-dynamics")[0]
    assert version.tags["causes"] == "battery_sag"
    assert version.aliases == ("challenger",)
    write_transitions(drives / "sag.parquet", transitions)
    served = mlflow.pyfunc.load_model(f"models:/{version.name}/{version.number}")
    np.testing.assert_array_equal(served.predict(pd.read_parquet(drives / "sag.parquet")), predicted)
    provenance = Provenance.read(diagnosed / "simulation")
    held_out = provenance.unseen_part(read_recording(drives / "sag", extended.robot))
    assert set(held_out.runs) >= set(provenance.runs["test"])
    assert not set(held_out.runs) & set(provenance.runs["train"])


def test_its_run_names_reference_and_measured_session_with_digests_of_their_own(drives, diagnosed):
    (run,) = mlflow.search_runs(
        experiment_names=["swarmtwin/diagnosis"], filter_string=f"params.output = '{diagnosed}'", output_format="list"
    )
    recordings = {name: read_recording(drives / name, robot_named("mgr")) for name in ("reference", "sag")}
    assert {(each.dataset.name, each.tags[0].value, each.dataset.digest) for each in run.inputs.dataset_inputs} == {
        ("reference", "reference", recordings["reference"].digest[:36]),
        ("sag", "measured", recordings["sag"].digest[:36]),
    }


def test_its_run_says_in_a_sentence_what_was_found_and_keeps_the_report(diagnosed):
    (run,) = mlflow.search_runs(
        experiment_names=["swarmtwin/diagnosis"], filter_string=f"params.output = '{diagnosed}'", output_format="list"
    )
    note = run.data.tags["mlflow.note.content"]
    assert note == verdict_words(read_result(diagnosed))
    assert "of their speed by the session's end" in note
    assert "charge or exchange the battery" in note
    kept = {file.path for file in mlflow.MlflowClient().list_artifacts(run.info.run_id, "diagnosis")}
    assert {"diagnosis/report.html", "diagnosis/diagnosis.json"} <= kept


def test_the_result_keeps_how_probable_the_leading_sets_are(diagnosed):
    diagnosis = read_result(diagnosed)
    sets = {one.causes: one for one in diagnosis.posterior}
    assert diagnosis.posterior[0].causes == ("battery_sag",)
    assert len(sets) == len(diagnosis.posterior) <= 8
    assert sets["battery_sag",].log_evidence > 100
    assert sets[()].log_evidence == 0
    assert sum(one.probability for one in diagnosis.posterior) <= 1 + 1e-5
    together = sum(one.probability for one in diagnosis.posterior if "battery_sag" in one.causes)
    assert together == pytest.approx(diagnosis.causes[0].posterior, abs=1e-3)
    told = VerdictSettings().confidence("battery_sag", diagnosis.causes[0].posterior)
    assert diagnosis.causes[0].confidence == pytest.approx(told, abs=1e-5)
    limits = {limit.cause: limit for limit in diagnosis.detection_limits}
    assert {"battery_sag", "command_delay", "command_loss", "noise_change", "dead_band"} <= limits.keys()
    assert limits["battery_sag"].value < diagnosis.causes[0].parameters["loss"].value


@pytest.mark.end_to_end
def test_a_reference_of_several_recordings_shows_how_far_their_vehicles_differ(drives, tmp_path):
    """Of two units each difference counts as one in three, beside the prior's two."""
    record = ("record", "robot=mgr", "steps=30", "runs=40")
    call(*record, "vehicle=2", "seed=7", f"output={tmp_path / 'second'}")
    call(*record, "vehicle=3", "seed=8", SAG, f"output={tmp_path / 'measured'}")
    several = f"reference=[{drives / 'reference'},{tmp_path / 'second'}]"
    quick = (*QUICK, "pictures=false", "register=false")
    call("diagnose", "robot=mgr", several, f"measured={tmp_path / 'measured'}", *quick, f"output={tmp_path / 'found'}")
    found = json.loads((tmp_path / "found" / "diagnosis.json").read_text())
    (unit,) = found["units"]
    usual = [unit[name]["usual"] for name in ("way", "turn", "left_to_right")]
    assert unit["vehicle"] == "3"
    assert len(set(usual)) == 3
    assert all(0.03 < one < 0.07 for one in usual)
    assert [cause["name"] for cause in found["causes"]] == ["battery_sag"]


@pytest.mark.end_to_end
def test_what_held_out_runs_do_not_confirm_is_neither_named_nor_kept_nor_registered(drives, tmp_path, capfd):
    """A session whose every fourth run, which is held out, has nothing wrong."""
    mixed = tmp_path / "mixed"
    shutil.copytree(drives / "sag", mixed)
    for file in sorted((drives / "clean" / "runs").iterdir())[3::4]:
        shutil.copy(file, mixed / "runs")
    known, output = versions("mgr-dynamics"), tmp_path / "diagnosis"
    given = (f"reference={drives / 'reference'}", f"measured={mixed}")
    call("diagnose", "robot=mgr", *given, *QUICK, "pictures=false", f"output={output}")
    diagnosis = json.loads((output / "diagnosis.json").read_text())
    assert max(diagnosis["gain"][name]["low"] for name in ("position_mm", "orientation_deg")) < 0
    assert (diagnosis["verdict"], diagnosis["causes"]) == ("unexplained", [])
    assert "neither position nor orientation is measurably better" in diagnosis["not_confirmed"]
    assert "held-out runs do not confirm" in capfd.readouterr().out
    assert not (output / "simulation").exists()
    assert versions("mgr-dynamics") == known


@pytest.mark.end_to_end
def test_what_is_not_measurably_better_in_open_loop_is_kept_and_not_registered(drives, tmp_path, capfd, monkeypatch):
    said = "in open loop over ten periods it is not measurably better"
    monkeypatch.setattr(extension, "not_shown_in_open_loop", lambda *given: said)
    known, output = versions("mgr-dynamics"), tmp_path / "diagnosis"
    given = (f"reference={drives / 'reference'}", f"measured={drives / 'sag'}")
    call("diagnose", "robot=mgr", *given, *QUICK, f"output={output}")
    assert (output / "simulation").exists()
    assert versions("mgr-dynamics") == known
    assert f"extended simulation not registered: {said}" in capfd.readouterr().out
    assert f"The extension is kept, but not registered: {said}." in (output / "report.html").read_text()


def test_the_report_stands_alone(diagnosed):
    page = (diagnosed / "report.html").read_text()
    assert "battery" in page.lower()
    assert "http://" not in page
    assert "https://" not in page


@pytest.mark.end_to_end
def test_a_trained_simulation_is_diagnosed_by_its_folder(drives):
    model = drives / "model"
    call(
        "train",
        "robot=mgr",
        "model=mlp",
        "model.steps=400",
        "trainer.logger=none",
        "seeds=1",
        f"recording={drives / 'reference'}",
        "split.fractions.train=0.6",
        "split.fractions.validation=0.2",
        "split.fractions.test=0.2",
        "pictures=false",
        f"output={model}",
    )
    output = drives / "by_model"
    call(
        "diagnose",
        "robot=mgr",
        f"simulation={model}",
        f"measured={drives / 'sag'}",
        f"output={output}",
        *QUICK,
        "register=false",
        "pictures=false",
    )
    diagnosis = json.loads((output / "diagnosis.json").read_text())
    assert [cause["name"] for cause in diagnosis["causes"]] == ["battery_sag"]
    extended = load_simulation(output / "simulation")
    assert extended.dynamics.dynamics.config.name == "mlp"
    with_its_own = drives / "by_model_and_its_recording"  # which adds nothing to its evidence, and takes nothing away
    given = (f"simulation={model}", f"reference={drives / 'reference'}", f"measured={drives / 'sag'}")
    call("diagnose", "robot=mgr", *given, f"output={with_its_own}", *QUICK, "register=false", "pictures=false")
    assert json.loads((with_its_own / "diagnosis.json").read_text())["causes"] == diagnosis["causes"]


@pytest.mark.end_to_end
def test_the_answer_book_is_not_read_and_the_same_seed_gives_the_same_answer(drives, tmp_path, diagnosed):
    """Without truth and provenance beside the recordings the diagnosis is the same, to the last digit."""
    for name in ("reference", "sag"):
        shutil.copytree(drives / name, tmp_path / name)
        (tmp_path / name / "truth.parquet").unlink()
        (tmp_path / name / "provenance.json").unlink(missing_ok=True)
    output = tmp_path / "diagnosis"
    call(
        "diagnose",
        "robot=mgr",
        f"reference={tmp_path / 'reference'}",
        f"measured={tmp_path / 'sag'}",
        f"output={output}",
        *QUICK,
        "register=false",
        "pictures=false",
    )
    assert (output / "diagnosis.json").read_text() == (diagnosed / "diagnosis.json").read_text()


@pytest.mark.parametrize(
    ("options", "message"),
    [
        (["reference={}/reference", "measured={}/reference"], "are also in the reference"),
        (["reference={}/reference", "measured={}/short"], "too few to conclude"),
        (["reference={}/short", "measured={}/sag"], "too few to conclude"),
        (["measured={}/sag"], "give reference="),
        (["reference={}/reference", "measured={}/nowhere"], "nowhere"),
        (["robot=mur", "reference={}/reference", "measured={}/sag"], "mgr"),
        (["simulation={}/reference", "measured={}/sag"], "model.yaml"),
    ],
)
def test_what_cannot_be_concluded_is_said_in_one_line(drives, tmp_path, options, message, capfd):
    given = [option.format(drives) for option in options]
    status = call("diagnose", *given, f"output={tmp_path / 'out'}", expected=2)
    assert status == 2
    said = capfd.readouterr().err
    assert message in said
    assert "Traceback" not in said
    assert not (tmp_path / "out").exists()


def test_constant_commands_are_refused_before_anything_is_learned(drives, tmp_path, capfd, monkeypatch):
    monkeypatch.setattr(Reference, "learn", None)
    constant = tmp_path / "constant"
    shutil.copytree(drives / "clean", constant)
    for file in (constant / "runs").glob("*.csv"):
        rows = pd.read_csv(file)
        driven = rows["left"].notna()
        rows.loc[driven, ["left", "right"]] = 40
        rows.to_csv(file, index=False)
    call(
        "diagnose",
        "robot=mgr",
        f"reference={drives / 'reference'}",
        f"measured={constant}",
        f"output={tmp_path / 'out'}",
        expected=2,
    )
    assert "constant command" in capfd.readouterr().err


def test_an_extended_simulation_is_not_diagnosed_again(drives, diagnosed, tmp_path, capfd):
    given = (
        f"simulation={diagnosed / 'simulation'}",
        f"measured={drives / 'clean'}",
        f"reference={drives / 'reference'}",
    )
    call("diagnose", "robot=mgr", *given, f"output={tmp_path / 'out'}", expected=2)
    assert "diagnose the one that it extends" in capfd.readouterr().err
    assert not (tmp_path / "out").exists()


LATE = "effects=[{name: command_delay, delay_s: 0.15}]"


@pytest.mark.parametrize(("effect", "named"), [(LATE, set()), (SAG, {"battery_sag", "gain_change"})])
def test_what_the_reference_has_as_well_is_no_gap_but_for_what_no_simulation_knows(drives, tmp_path, effect, named):
    """A simulation knows no age: one learned of an ageing robot is an average, and the session departs from that."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(Physics, "bank_rows", 4096)
        for number, name in enumerate(("reference", "measured")):
            output = f"output={tmp_path / name}"
            call("record", "robot=mgr", "steps=30", "runs=40", f"seed={7 + number}", effect, output)
    output, given = tmp_path / "out", (f"reference={tmp_path / 'reference'}", f"measured={tmp_path / 'measured'}")
    call("diagnose", "robot=mgr", *given, *QUICK, "register=false", "pictures=false", f"output={output}")
    result = read_result(output)
    assert result.verdict == ("explained" if named else "no_gap")
    assert {cause.name for cause in result.causes} == named
    for cause in result.causes:
        if cause.name == "battery_sag":
            assert cause.parameters["loss"].low < 0.35 < cause.parameters["loss"].high


@pytest.mark.end_to_end
def test_one_long_run_is_diagnosed_by_its_blocks(drives, tmp_path):
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(Physics, "bank_rows", 4096)
        call("record", "robot=mgr", "steps=1500", "runs=1", "seed=9", SAG, f"output={tmp_path / 'long'}")
    given, output = (f"reference={drives / 'reference'}", f"measured={tmp_path / 'long'}"), tmp_path / "out"
    call("diagnose", "robot=mgr", *given, *QUICK, "register=false", "pictures=false", f"output={output}")
    result = read_result(output)
    assert sum(result.runs.values()) > 8
    assert [cause.name for cause in result.causes] == ["battery_sag"]
    assert result.causes[0].parameters["loss"].low < 0.35 < result.causes[0].parameters["loss"].high


def test_a_clock_that_was_never_set_changes_nothing(drives, diagnosed, tmp_path):
    """A battery ages from the session's beginning on, whatever the clock shows then."""
    late = tmp_path / "late"
    shutil.copytree(drives / "sag", late)
    for file in (late / "runs").glob("*.csv"):
        rows = pd.read_csv(file)
        rows["time_s"] += 1_732_000_000.0
        rows.to_csv(file, index=False)
    output, given = tmp_path / "out", (f"reference={drives / 'reference'}", f"measured={late}")
    call("diagnose", "robot=mgr", *given, *QUICK, "register=false", "pictures=false", f"output={output}")
    found, expected = read_result(output), read_result(diagnosed)
    assert [cause.name for cause in found.causes] == [cause.name for cause in expected.causes]
    loss, on_time = (one.causes[0].parameters["loss"].value for one in (found, expected))
    assert loss == pytest.approx(on_time, rel=1e-3)
