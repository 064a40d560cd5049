"""What is registered is an MLflow model: loaded, described and served by MLflow itself, and refused where changed."""

import json
import shutil
from pathlib import Path

import mlflow
import numpy as np
import pandas as pd
import pytest
import yaml

from exact_model import LaggingDynamics, simulation_with, situation_of
from swarmtwin.dynamics.evaluation import predict
from swarmtwin.dynamics.model_config import config_class
from swarmtwin.dynamics.predictor import NetworkDynamics
from swarmtwin.errors import UserError
from swarmtwin.files import folder_digest
from swarmtwin.policies.policy_folder import load_policy
from swarmtwin.simulation.pyfunc import ServedSimulation
from swarmtwin.simulation.simulation import Simulation
from swarmtwin.simulation.simulation_folder import load_simulation
from swarmtwin.tracking import registry
from swarmtwin.tracking.model_source import model_folder
from swarmtwin.tracking.runs import tracked_run
from swarmtwin.transitions.storage import write_transitions
from tiny_policies import robot_named, save_seeker, simulation
from toy import toy_transitions

MGR = robot_named("mgr")


def register(folder, kind):
    """Register a model as its command would; return the version."""
    with tracked_run(kind, "a test", {}) as run:
        kept = run.model(folder, kind)
    version = registry.register(f"mgr-{kind}", folder, kept, run.run_id, {})
    registry.challenge(version, lambda challenger: (True, "newer"))
    return version


@pytest.fixture(scope="module")
def store(tmp_path_factory):
    """A folder with an MLflow store, where a simulation with evidence beside it and a policy are registered."""
    place = tmp_path_factory.mktemp("store")
    with pytest.MonkeyPatch.context() as patch:
        patch.chdir(place)
        patch.delenv("MLFLOW_TRACKING_URI", raising=False)
        folder = simulation(place / "some folder", MGR)
        write_transitions(folder / "evidence.parquet", toy_transitions(MGR, 100))
        register(folder, "dynamics")
        register(save_seeker(place / "seeker"), "policy")
    return place


@pytest.fixture
def dynamics(store, monkeypatch):
    """The registered simulation, whose files are put back afterwards."""
    monkeypatch.chdir(store)
    monkeypatch.delenv("MLFLOW_TRACKING_URI", raising=False)
    version = registry.find_version("models:/mgr-dynamics@challenger")
    kept = version.folder().parents[1]
    files = {file: file.read_bytes() for file in kept.rglob("*") if file.is_file()}
    yield version
    for file, content in files.items():
        file.write_bytes(content)


def test_mlflow_predicts_from_a_table_of_transitions_what_we_predict(dynamics, store, tmp_path):
    transitions = toy_transitions(MGR, 200, noise=(1, 1, 0.1))
    write_transitions(tmp_path / "transitions.parquet", transitions)
    table = pd.read_parquet(tmp_path / "transitions.parquet")
    answer = mlflow.pyfunc.load_model("models:/mgr-dynamics@challenger").predict(table)
    assert list(answer.columns) == ["forward_mm", "left_mm", "turn_rad"]
    np.testing.assert_array_equal(answer, predict(load_simulation(store / "some folder"), transitions))
    assert np.abs(answer).to_numpy().max() > 1


def test_the_version_leads_to_its_run_its_model_and_its_signature(dynamics):
    client = mlflow.MlflowClient()
    version = client.get_model_version_by_alias("mgr-dynamics", "challenger")
    (output,) = client.get_run(version.run_id).outputs.model_outputs
    logged = client.get_logged_model(output.model_id)
    assert logged.artifact_location == version.source
    assert json.loads(logged.tags["mlflow.modelVersions"]) == [{"name": "mgr-dynamics", "version": 1}]
    about = mlflow.models.get_model_info("models:/mgr-dynamics@challenger")
    assert about.signature.inputs.input_names() == ["left", "right"]
    assert about.signature.outputs.input_names() == ["forward_mm", "left_mm", "turn_rad"]
    assert about.flavors["python_function"]["loader_module"] == "swarmtwin.simulation.pyfunc"
    kept = Path(logged.artifact_location.removeprefix("file://"))
    assert not [file for file in kept.rglob("*") if file.suffix in (".pkl", ".pickle", ".joblib", ".py")]
    assert (kept / "requirements.txt").read_text().splitlines() == [f"mlflow=={mlflow.__version__}", "swarmtwin==0.1.0"]
    assert dynamics.folder() == kept / "data" / "model"
    assert dynamics.tags["digest"] == folder_digest(dynamics.folder())


def test_mlflow_serves_the_input_example(dynamics, tmp_path):
    loaded = mlflow.pyfunc.load_model("models:/mgr-dynamics/1")
    given, output = tmp_path / "given.json", tmp_path / "answer.json"
    given.write_text(json.dumps({"dataframe_split": loaded.input_example.to_dict("split")}))
    mlflow.models.predict("models:/mgr-dynamics/1", input_path=given, output_path=output, env_manager="local")
    served = pd.DataFrame(json.loads(output.read_text())["predictions"])
    np.testing.assert_allclose(served, loaded.predict(loaded.input_example))


def test_a_policy_commands_from_a_table_of_observations_what_it_commands_elsewhere(dynamics, store):
    loaded, ours = mlflow.pyfunc.load_model("models:/mgr-policy@challenger"), load_policy(store / "seeker")
    assert loaded.metadata.signature.inputs.input_names() == list(ours.policy.observation_names)
    assert loaded.metadata.signature.outputs.input_names() == ["left", "right"]
    observed = np.random.default_rng(0).normal(size=(50, len(ours.policy.observation_names)))
    answer = loaded.predict(pd.DataFrame(observed, columns=ours.policy.observation_names))
    np.testing.assert_array_equal(answer, ours.policy.act(observed[None])[0])
    assert len(loaded.predict(loaded.input_example)) == 2


def test_a_model_that_looks_at_velocity_answers_with_and_without_it(robots):
    dynamics = NetworkDynamics(robots["car"], config_class("kinematic")(situation=("command", "velocity"))).eval()
    served = ServedSimulation(Simulation(dynamics))
    velocity = ("velocity_forward_mm_s", "velocity_left_mm_s", "velocity_turn_rad_s")
    assert (served.required, served.optional) == (("throttle", "steering_deg"), velocity)
    assert np.isfinite(served.predict(served.example)).all(axis=None)
    given = pd.DataFrame({"throttle": 0.0, "steering_deg": 0.0, velocity[0]: [1000.0, 0.0]})
    forward_mm = served.predict(given)["forward_mm"]
    left_over = np.exp(-0.2)  # of a speed that is asked for no more, at its time constant of five periods
    np.testing.assert_allclose(forward_mm, [1000 * left_over * 0.1, 0], rtol=1e-5)
    at_rest = served.predict(given.drop(columns=velocity[0]))
    np.testing.assert_allclose(at_rest, 0, atol=1e-9)


def test_an_extended_simulation_answers_its_most_likely_step(robots):
    extended = simulation_with(
        robots["mgr"],
        LaggingDynamics(robots["mgr"]),
        battery_sag={"loss": 0.3, "shape": 1.5},
        neighbour_interaction={"strength_mm_s": 8.0, "reach_mm": 120.0},
    )
    served = ServedSimulation(extended)
    assert served.required == ("left", "right", "x_mm", "y_mm", "heading_rad", "time_s")
    assert served.optional[:4] == ("previous_left", "previous_right", "neighbour_1_forward_mm", "neighbour_1_left_mm")
    situation = situation_of(robots["mgr"], np.random.default_rng(1))
    columns = served.columns
    table = pd.concat(
        [
            pd.DataFrame(getattr(situation, part).reshape(200, -1), columns=list(columns[part])[:3])
            for part in ("command", "previous_command", "pose", "elapsed_s", "neighbours")
        ],
        axis="columns",
    )
    expected = extended.predict(situation.only(extended.inputs))
    np.testing.assert_allclose(served.predict(table), expected, rtol=1e-4, atol=1e-4)  # tables are read in float32
    alone = served.predict(table[list(served.required)])
    assert np.isfinite(alone).all(axis=None)
    assert np.abs(alone - served.predict(table)).to_numpy().max() > 1


def test_changed_weights_are_refused_by_mlflow_too(dynamics):
    file = dynamics.folder() / "model.yaml"
    file.write_text(file.read_text().replace("120", "1200"))
    with pytest.raises(UserError, match="is not what was registered: its digest is") as told:
        mlflow.pyfunc.load_model("models:/mgr-dynamics@challenger")
    assert dynamics.tags["digest"] in str(told.value)
    assert folder_digest(file.parent) in str(told.value)


@pytest.mark.parametrize("name", ["MLmodel", "data/model/evidence.parquet", "input_example.json", "requirements.txt"])
def test_no_file_of_a_version_can_change_unnoticed(dynamics, name):
    kept = dynamics.folder().parents[1]
    mlflow.pyfunc.load_model("models:/mgr-dynamics@challenger")  # which leaves a note of MLflow's beside them
    assert (kept / "registered_model_meta").exists()
    assert model_folder("models:/mgr-dynamics@challenger") == dynamics.folder()
    content = (kept / name).read_bytes()
    (kept / name).write_bytes(content.replace(b"swarmtwin.simulation.pyfunc", b"somebody.elses.pyfunc") + b" ")
    with pytest.raises(UserError, match="are not those that were registered: their digest is") as told:
        model_folder("models:/mgr-dynamics@challenger")
    assert dynamics.tags["files.digest"] in str(told.value)


def test_an_mlmodel_file_that_states_no_digest_is_refused(dynamics):
    file = dynamics.folder().parents[1] / "MLmodel"
    file.write_text(yaml.safe_dump({**yaml.safe_load(file.read_text()), "metadata": None}))
    with pytest.raises(UserError, match="MLmodel does not state the digest of"):
        mlflow.pyfunc.load_model("models:/mgr-dynamics@challenger")


def test_a_copy_elsewhere_is_compared_as_well(dynamics, tmp_path):
    copy = shutil.copytree(dynamics.folder().parents[1], tmp_path / "copy")
    loaded = mlflow.pyfunc.load_model(str(copy))
    assert len(loaded.predict(loaded.input_example)) == 3
    (copy / "data" / "model" / "weights.safetensors").write_bytes(b"")
    with pytest.raises(UserError, match="is not what was registered"):
        mlflow.pyfunc.load_model(str(copy))


def test_versions_registered_as_bare_folders_are_still_loaded_and_compared(dynamics, tmp_path):
    folder = simulation(tmp_path / "bare", MGR)
    with tracked_run("dynamics", "of before", {}) as run:
        source = run.folder(folder, "model")
    client = mlflow.MlflowClient()
    client.create_registered_model("bare-dynamics")
    client.create_model_version("bare-dynamics", source, run.run_id, tags={"digest": folder_digest(folder)})
    kept = model_folder("models:/bare-dynamics/1")
    assert load_simulation(kept).robot == MGR
    (kept / "MLmodel").write_text("flavors: {}")  # planted, with another model beside it
    shutil.copytree(folder, kept / "data" / "model")
    assert model_folder("models:/bare-dynamics/1") == kept
    (kept / "model.yaml").write_text("")
    with pytest.raises(UserError, match="are not those that were registered"):
        model_folder("models:/bare-dynamics/1")
