"""`swarmtwin experiment name=pictures`: what a command left, drawn again from its folder alone."""

import hashlib
import shutil
from pathlib import Path

import mlflow
import pytest
from test_experiments import COMPARISON
from test_learn import WITH_PICTURES

from swarmtwin.tracking.store import use_store
from tiny_policies import save_seeker, simulation


def digest(file):
    return hashlib.sha256(file.read_bytes()).hexdigest()


def redrawn(swarmtwin, workshop, folder):
    """Draw a folder again; return the digests of the drawings of both by their paths."""
    answer = swarmtwin("experiment", "name=pictures", f"folder={folder}", f"output={folder}-again")
    assert answer.status == 0, answer.error
    return [
        {str(file.relative_to(place)): digest(file) for file in place.rglob("*.*") if file.suffix in ENDINGS}
        for place in (workshop / folder, workshop / f"{folder}-again")
    ]


ENDINGS = (".png", ".mp4", ".html")
SMALL = ("generator.mean_model_steps=10", "generator.noise_steps=10")


@pytest.mark.parametrize(
    ("command", "drawn"),
    [
        (("prepare", "recording=reference"), {"coverage.png"}),
        (("train", "recording=reference", "model=mlp", "model.steps=12", "register=false", "seeds=2"), {"history.png"}),
        (("generate", "robot=mgr", "recording=reference", *SMALL), {"quality.png", "history.png"}),
        (("evaluate", "simulation=mlp", "recording=pair"), {"runs.png", "scatter.png"}),
        ((*WITH_PICTURES, "seeds=2", "register=false"), {"history.png", "rollout.mp4"}),
    ],
    ids=lambda value: value[0] if isinstance(value, tuple) else "",
)
def test_a_drawing_is_the_same_from_the_folder_alone(swarmtwin, model, workshop, monkeypatch, command, drawn):
    monkeypatch.setenv("LOKY_MAX_CPU_COUNT", "1")  # two seeds need no processes
    model("mlp")
    assert swarmtwin(*command, "output=made").status == 0
    first, again = redrawn(swarmtwin, workshop, "made")
    assert set(first) == drawn
    assert first == again


def test_so_are_comparisons_and_a_command_can_leave_drawing_to_it(swarmtwin, model, workshop):
    for name in ("kinematic", "mlp"):
        model(name, f"models/{name}")
    assert swarmtwin(*COMPARISON, "output=whole").status == 0
    assert swarmtwin(*COMPARISON, "pictures=false", "output=bare").status == 0
    drawn, again = redrawn(swarmtwin, workshop, "whole")
    bare, later = redrawn(swarmtwin, workshop, "bare")
    assert set(again) == {"errors_train_vehicle.png", "errors_other_vehicle.png", "runs_kinematic.png"}
    assert {name: picture for name, picture in drawn.items() if not name.startswith("best/")} == again == later
    assert not {name for name in bare if not name.startswith("best/")}
    use_store()
    asked = {
        "experiment_names": ["swarmtwin/dynamics"],
        "filter_string": "params.output = 'bare'",
        "output_format": "list",
    }
    (run,) = mlflow.search_runs(**asked)
    kept = mlflow.MlflowClient().list_artifacts(run.info.run_id, "pictures")
    assert {Path(entry.path).name for entry in kept} - {"provenance.json"} == set(again)


@pytest.mark.end_to_end
def test_so_are_rollouts_with_their_films(swarmtwin, workshop, robots):
    simulation(workshop / "kinematic", robots["mgr"])
    (workshop / "policies").mkdir()
    save_seeker(workshop / "policies" / "quick", source="kinematic")
    options = ("count=12", "speed=16")
    assert swarmtwin("rollout", "policy=policies/quick", *options, "show=worst", "output=rolled").status == 0
    first, again = redrawn(swarmtwin, workshop, "rolled")
    assert set(first) == {"rollouts.html", "rollouts.png", "rollout.mp4"}
    assert first == again
    assert swarmtwin("experiment", "name=transfer", "policies=policies", *options, "output=transfer").status == 0
    first, again = redrawn(swarmtwin, workshop, "transfer")
    assert set(first) == {"rewards.png", "success.png", "paths_quick.png", "quick.mp4"}
    assert first == again


def test_several_folders_are_drawn_side_by_side(swarmtwin, library, workshop):
    shutil.copytree(library / "models", workshop / "models")
    _, again = redrawn(swarmtwin, workshop, "models")
    assert set(again) == {f"{folder.name}/history.png" for folder in (library / "models").iterdir()}


def test_a_name_with_an_apostrophe_is_a_name_like_any_other(swarmtwin, library, workshop):
    shutil.copytree(library / "models" / "mlp", workshop / "it's")
    answer = swarmtwin("experiment", "name=pictures", 'folder="it\'s"', "output=out")
    assert answer.status == 0, answer.error
    assert (workshop / "out" / "history.png").exists()


@pytest.mark.parametrize(
    ("folder", "message"),
    [
        ("nowhere", "nowhere holds no output of swarmtwin: name a folder that one of its commands left"),
        ("reference", "reference was made by swarmtwin record, of which there are no pictures: leave it out"),
    ],
)
def test_a_mistake_is_one_line_and_leaves_nothing(swarmtwin, workshop, folder, message):
    answer = swarmtwin("experiment", "name=pictures", f"folder={folder}", "output=out")
    assert answer.status == 2
    assert answer.error == f"swarmtwin experiment: {message}\n"
    assert not (workshop / "out").exists()
