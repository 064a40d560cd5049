"""One of each kind of plug-in from a folder outside the package, `tests/outside/`, taken through its whole way.

A robot with kinematics and a stand-in of its own, an importer, a dynamics model, a generator, a task, an algorithm and
a mechanism: each is one file of code and one of configuration, and no file of the package knows any of them.
"""

import json
import os
import subprocess
import sys
from pathlib import Path

import pandas as pd
import pytest
import yaml

pytestmark = pytest.mark.end_to_end
OUTSIDE = Path(__file__).resolve().parent / "outside"
RUN_EACH_LINE = """
import shlex, sys
from swarmtwin.commands import main
for line in sys.stdin:
    sys.argv = ["swarmtwin", *shlex.split(line)]
    try:
        main()
    except SystemExit as ended:
        if ended.code:
            sys.exit(f"{line}: exit status {ended.code}")
"""
WAY = """
record robot=cart vehicle=1 runs=40 steps=20 seed=1 output=reference
record robot=cart vehicle=9 runs=40 steps=20 seed=2 output=worn
import robot=cart source=logbook path=. run_s=5 output=imported
prepare robot=cart recording=imported output=prepared
train robot=cart model=two_layers recording=reference recipe.batch_size=64 seeds=2 register=false output=model
train robot=cart model=kinematic recording=reference model.steps=300 {alone} output=kinematic
evaluate robot=cart simulation=model recording=worn output=evaluated
generate robot=cart generator=small_gan recording=reference count=200 output=synthetic
learn robot=cart task=visit policy=patient_td3 simulation=model evaluate_every=30 scenes=20 {alone} output=policy
rollout robot=cart policy=policy count=10 video=false output=rollouts
diagnose robot=cart reference=reference measured=worn {quick} register=false pictures=false output=diagnosis
""".replace("{alone}", "seeds=1 register=false").replace(" scenes=20", " scenes=20 final_scenes=20")
WAY = WAY.replace("{quick}", "diagnosis.reference.folds=3 diagnosis.search.most_causes=1")


@pytest.fixture(scope="module")
def way(made_once):
    """The folder in which all commands have run, one after the other in a process of their own."""
    return made_once("way_of_plugins", go_all_the_way)


def go_all_the_way(folder):
    ticks = pd.DataFrame({"seconds": [tick / 2 for tick in range(80)], "who": "7", "l": 40, "r": 40, "angle_deg": 0})
    ticks.assign(x=100 + 20 * (ticks.index % 40), y=500).to_csv(folder / "log.csv", index=False)
    environment = {**os.environ, "SWARMTWIN_PLUGINS": str(OUTSIDE)}
    environment.pop("MLFLOW_TRACKING_URI", None)
    answer = subprocess.run(
        [sys.executable, "-c", RUN_EACH_LINE],
        input=WAY.strip(),
        cwd=folder,
        env=environment,
        capture_output=True,
        text=True,
    )
    assert answer.returncode == 0, answer.stdout + answer.stderr


def content(file):
    return yaml.safe_load(file.read_text())


def test_a_robot_and_its_stand_in_are_recorded(way):
    assert content(way / "reference" / "recording.yaml")["robot"] == "cart"


def test_foreign_data_are_imported_and_prepared(way):
    assert content(way / "imported" / "recording.yaml")["vehicles"] == ["7"]
    assert (way / "prepared" / "transitions.parquet").exists()


def test_a_dynamics_model_is_trained_and_evaluated(way):
    assert content(way / "model" / "model.yaml")["model"]["name"] == "two_layers"
    assert (way / "evaluated" / "metrics.json").exists()


def test_kinematics_are_fitted_to_the_robot_that_names_them(way):
    errors = json.loads((way / "kinematic" / "metrics.json").read_text())["validation"]
    assert errors["position_mm"] < 2


def test_a_generator_is_trained_and_drawn_from(way):
    assert (way / "synthetic" / "transitions").is_dir()


def test_a_policy_is_learned_for_a_task_and_rolled_out_on_the_stand_in(way):
    policy = content(way / "policy" / "policy.yaml")
    assert policy["task"]["name"] == "visit"
    rollouts = pd.read_parquet(way / "rollouts" / "rollouts.parquet")
    assert rollouts.groupby("world").rollout.nunique().to_dict() == {"simulation": 10, "stand_in": 10}


def test_a_mechanism_is_found_in_a_diagnosis(way):
    diagnosis = json.loads((way / "diagnosis" / "diagnosis.json").read_text())
    assert [cause["name"] for cause in diagnosis["causes"]] == ["weak_reverse"]
    loss = diagnosis["causes"][0]["parameters"]["loss"]
    assert loss["low"] < 1 / 3 < loss["high"]
