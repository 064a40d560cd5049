"""`swarmtwin experiment`: the table's numbers are those of `evaluate`, and the best is chosen by validation alone."""

import json
import re
import shutil
from html.parser import HTMLParser

import mlflow
import pandas as pd
import pytest
import yaml

from swarmtwin.commands.app import run_command
from swarmtwin.diagnosis.result import Cause, DiagnosisResult, Estimate, Gain, Gains
from swarmtwin.tracking.store import use_store

RECORDINGS = {"train_vehicle": "reference", "other_vehicle": "other_vehicle", "open_loop": "open_loop"}
COMPARISON = ("experiment", "name=dynamics", "models=models", *(f"{name}={path}" for name, path in RECORDINGS.items()))
UNDRAWN = (*COMPARISON, "pictures=false")
OVERVIEW = ("experiment", "name=overview", "robots=[mgr]", "output=overview")

SAG = DiagnosisResult(
    verdict="explained",
    causes=(
        Cause(
            name="battery_sag",
            parameters={"loss": Estimate(value=0.3, low=0.28, high=0.32, unit="")},
            confidence=1.0,
            rivals=(),
            share_of_gap=1.0,
            evidence="",
        ),
    ),
    depends_on=("time",),
    gain=Gains(
        position_mm=Gain(before=6.5, after=3.2, low=3.1, high=3.5),
        orientation_deg=Gain(before=5.0, after=4.0, low=0.9, high=1.1),
        open_loop_mm=Gain(before=300.0, after=90.0, low=190.0, high=230.0),
        ten_periods_mm=Gain(before=80.0, after=20.0, low=50.0, high=70.0),
    ),
    next_recording=None,
    left_over=(),
    tests=(),
    robot="mgr",
    vehicles=("1",),
    runs={},
    transitions={},
    extension="mechanisms",
    seed=0,
)


@pytest.fixture
def models(model):
    """The trained models in one folder, by name."""
    return {name: model(name, f"models/{name}") for name in ("kinematic", "mlp", "rough")}


def plant_validation(folder, position_mm, orientation_deg):
    """Claim other errors on the validation runs; on all other runs the model errs as before."""
    description = yaml.safe_load((folder / "model.yaml").read_text())
    description["provenance"]["seeds"][0] |= {"position_mm": position_mm, "orientation_deg": orientation_deg}
    (folder / "model.yaml").write_text(yaml.safe_dump(description))


@pytest.mark.usefixtures("undrawn")
def test_the_table_holds_the_numbers_of_evaluate(swarmtwin, models, workshop):
    assert swarmtwin(*UNDRAWN, "output=out").status == 0
    table = pd.read_csv(workshop / "out" / "table.csv").set_index(["model", "recording"])
    metrics = json.loads((workshop / "out" / "metrics.json").read_text())
    assert set(table.index) == {(name, recording) for name in models for recording in RECORDINGS}
    for name, recording in (("mlp", "train_vehicle"), ("mlp", "other_vehicle"), ("kinematic", "open_loop")):
        output = f"evaluation-{name}-{recording}"
        assert (
            swarmtwin(
                "evaluate", f"simulation={models[name]}", f"recording={RECORDINGS[recording]}", f"output={output}"
            ).status
            == 0
        )
        evaluated = json.loads((workshop / output / "metrics.json").read_text())
        about = ("robot", "model", "recording")
        assert metrics[name][recording] == {key: value for key, value in evaluated.items() if key not in about}
        row = table.loc[name, recording]
        assert row.transitions == evaluated["transitions"]
        for figure in ("one_step", "floor", "model_error"):
            for error, unit in (("position", "mm"), ("orientation", "deg")):
                expected = evaluated[figure][f"{error}_{unit}"]
                assert row[f"{figure}_{error}_{unit}"] == pytest.approx(expected["mean"], abs=6e-5)
                assert row[f"{figure}_{error}_sd_{unit}"] == pytest.approx(expected["sd"], abs=6e-5)
        assert row.open_loop_mm == pytest.approx(evaluated["open_loop"]["rmse_mm"]["mean"], abs=6e-3)
    for name in models:
        summary = json.loads((workshop / "out" / "summary" / f"{name}.json").read_text())
        assert summary["position_mm"] == metrics[name]["train_vehicle"]["one_step"]["position_mm"]["mean"]
        assert summary["open_loop_mm"] == metrics[name]["open_loop"]["open_loop"]["rmse_mm"]["mean"]
        assert len(summary) == 5
    worst_first = table.xs("train_vehicle", level="recording").one_step_position_mm
    assert list(worst_first) == sorted(worst_first, reverse=True)


def test_the_best_is_chosen_by_validation_and_never_by_the_test(swarmtwin, models, workshop):
    plant_validation(models["rough"], 1.0, 1.0)
    answer = swarmtwin(*UNDRAWN, "output=out")
    assert answer.status == 0
    table = pd.read_csv(workshop / "out" / "table.csv").query("recording == 'train_vehicle'").set_index("model")
    assert table.one_step_position_mm["rough"] > table.one_step_position_mm["mlp"]
    for file in ("model.yaml", "weights.safetensors"):
        assert (workshop / "out" / "best" / file).read_bytes() == (models["rough"] / file).read_bytes()
    assert "rough *" in answer.shown
    use_store()
    (run,) = mlflow.search_runs(experiment_names=["swarmtwin/dynamics"], output_format="list")
    assert run.data.tags["best_model"] == "rough"


def test_position_and_orientation_weigh_alike_in_the_choice(swarmtwin, models, workshop):
    plant_validation(models["kinematic"], 3.0, 4.4)
    plant_validation(models["mlp"], 3.2, 4.0)  # 7 % more position error, but 9 % less orientation error
    plant_validation(models["rough"], 9.0, 9.0)
    assert swarmtwin(*UNDRAWN, "output=out").status == 0
    assert (workshop / "out" / "best" / "model.yaml").read_bytes() == (models["mlp"] / "model.yaml").read_bytes()


@pytest.mark.parametrize(
    ("options", "message"),
    [
        (["models=nowhere"], "no folder nowhere with models: run `dvc repro` first"),
        (["models=reference"], "reference holds no model folder: run `dvc repro` first"),
        (["open_loop=elsewhere"], "no recording folder elsewhere"),
        (["robot=mur"], "reference/recording.yaml: the recording is of robot 'mgr', not of 'mur'"),
    ],
)
def test_what_is_missing_is_one_line(swarmtwin, models, workshop, options, message):
    answer = swarmtwin(*COMPARISON, *options, "output=out")
    assert answer.status == 2
    assert answer.error.startswith(f"swarmtwin experiment: {message}")
    assert len(answer.error.strip().splitlines()) == 1
    assert not (workshop / "out").exists()


@pytest.fixture(scope="module")
def compared(library, tmp_path_factory):
    """A folder to copy: artifacts/ with a recording that was prepared and models that were compared, and pictures."""
    folder = tmp_path_factory.mktemp("compared")
    comparison = ["name=dynamics", f"models={library}/models"]
    comparison += [f"{name}={library / path}" for name, path in RECORDINGS.items()]
    with pytest.MonkeyPatch.context() as patch:
        patch.chdir(folder)
        patch.delenv("MLFLOW_TRACKING_URI", raising=False)
        shutil.copy(library / "empty.db", "mlflow.db")
        prepared = run_command("prepare", [f"recording={library}/reference", "output=artifacts/transitions/mgr"])
        assert prepared == run_command("experiment", [*comparison, "output=artifacts/comparison/mgr"]) == 0
    return folder / "artifacts"


class Page(HTMLParser):
    """What a page would load, and what it says."""

    def __init__(self, text):
        super().__init__()
        self.loaded, self.words = [], []
        self.feed(text)

    def handle_starttag(self, tag, attrs):
        self.loaded += [value for name, value in attrs if name in ("src", "href", "srcset", "data", "action")]

    def handle_data(self, data):
        self.words += data.split()


def test_the_overview_is_one_page_that_loads_nothing_and_shows_the_champion(swarmtwin, compared, workshop, crown):
    answer = swarmtwin(*OVERVIEW)
    assert answer.status == 2
    assert answer.error == (
        "swarmtwin experiment: artifacts/comparison/mgr holds no comparison of models: run `dvc repro` first\n"
    )
    shutil.copytree(compared, workshop / "artifacts")
    assert swarmtwin(*OVERVIEW).status == 0
    assert "No champion is registered yet." in " ".join(Page((workshop / "overview/overview.html").read_text()).words)

    crown(workshop / "artifacts/comparison/mgr/best")
    crown(workshop / "artifacts/comparison/mgr/best", "mgr-policy", task="obstacle")
    answer = swarmtwin(*OVERVIEW)
    assert answer.status == 0
    text = (workshop / "overview" / "overview.html").read_text()
    page = Page(text)
    assert len(page.loaded) >= 2
    assert all(source.startswith("data:image/png;base64,iVBOR") for source in page.loaded)
    for loader in ("@import", "url(", "<script", "<link"):
        assert loader not in text
    words = " ".join(page.words)
    assert "Registered champion: mgr-dynamics version 1 (planted)." in words
    assert "Registered champion: mgr-policy version 1 for task obstacle (planted)." in words
    assert "No champion is registered" not in words
    table = pd.read_csv(workshop / "artifacts" / "comparison" / "mgr" / "table.csv")
    for row in table.query("recording == 'train_vehicle'").itertuples():
        assert f"{row.one_step_position_mm:.2f} ± {row.one_step_position_sd_mm:.2f}" in words
        assert f"{row.one_step_position_mm:.2f} ± {row.one_step_position_sd_mm:.2f}" in answer.shown


def test_the_overview_marks_the_best_of_two_models_of_one_kind(swarmtwin, models, compared, workshop):
    plant_validation(models["rough"], 1.0, 1.0)
    shutil.copytree(compared / "transitions", workshop / "artifacts" / "transitions")
    swarmtwin(*UNDRAWN, "output=artifacts/comparison/mgr")
    answer = swarmtwin(*OVERVIEW)
    assert "rough *" in answer.shown
    assert "mlp *" not in answer.shown
    text = (workshop / "overview" / "overview.html").read_text()
    assert re.search(r'<tr class="marked"><td>rough \*<br>', text)
    assert not re.search(r'<tr class="marked"><td>mlp', text)


def test_the_overview_tells_what_a_diagnosis_found(swarmtwin, compared, workshop):
    shutil.copytree(compared, workshop / "artifacts")
    folder = workshop / "artifacts" / "diagnosis" / "mgr"
    (folder / "figures").mkdir(parents=True)
    picture = next((workshop / "artifacts").rglob("*.png")).read_bytes()
    for name in ("time", "place"):
        (folder / "figures" / f"{name}.png").write_bytes(picture)
    (folder / "diagnosis.json").write_text(SAG.model_dump_json())
    answer = swarmtwin(*OVERVIEW)
    assert answer.status == 0
    said = "because the actuators lose 30 % of their speed by the session's end – charge or exchange the battery"
    shown = " ".join(answer.shown.split())
    assert said in shown
    assert "artifacts/diagnosis/mgr/report.html" in answer.shown
    page = Page((workshop / "overview" / "overview.html").read_text())
    words = " ".join(page.words)
    assert said in words
    assert "position after one period 6.50 mm 3.20 mm −3.3 mm (−3.5 to −3.1), −51 %" in words
    assert "Error over the session" in words
    assert "over the place" not in words
    assert "Unusual" not in words

    prepared = workshop / "artifacts" / "transitions" / "mgr" / "preparation.json"
    prepared.write_text(json.dumps(json.loads(prepared.read_text()) | {"warnings": ["is it clipped?", "x < y"]}))
    answer = swarmtwin(*OVERVIEW, "overwrite=true")
    assert "warning: mgr: is it clipped?\nwarning: mgr: x < y\n" in answer.shown
    text = (workshop / "overview" / "overview.html").read_text()
    assert "<li>is it clipped?</li><li>x &lt; y</li>" in text

    (folder / "diagnosis.json").write_text("{")
    answer = swarmtwin(*OVERVIEW, "overwrite=true")
    assert answer.status == 2
    assert "artifacts/diagnosis/mgr/diagnosis.json is damaged" in answer.error
