import numpy as np
import pytest
import torch
import yaml

from swarmtwin.dynamics.evaluation import predict
from swarmtwin.dynamics.model_config import config_class, model_names
from swarmtwin.dynamics.model_folder import load_dynamics, read_description, save_dynamics
from swarmtwin.dynamics.predictor import NetworkDynamics
from swarmtwin.dynamics.training import train
from swarmtwin.errors import UserError
from toy import recipe, toy_transitions


@pytest.fixture
def saved(robots, tmp_path):
    torch.manual_seed(0)
    save_dynamics(tmp_path, NetworkDynamics(robots["mgr"], config_class("mlp")()), {"seed": 3})
    return tmp_path


@pytest.mark.parametrize("name", model_names())
def test_a_model_saved_and_loaded_predicts_the_same_bit_for_bit(robots, tmp_path, name):
    transitions = toy_transitions(robots["mgr"], 600, noise=(1, 1, 0.03))
    dynamics = train(transitions, config_class(name)(), recipe(epochs=1, batch_size=128), [0]).dynamics
    save_dynamics(tmp_path, dynamics, {})
    loaded = load_dynamics(tmp_path)
    assert np.array_equal(predict(loaded, transitions), predict(dynamics, transitions))
    assert not loaded.training
    assert (loaded.config, loaded.robot, loaded.inputs) == (dynamics.config, dynamics.robot, dynamics.inputs)


def test_the_description_can_be_read_by_people(saved):
    content = yaml.safe_load((saved / "model.yaml").read_text())
    assert content["format"] == 1
    assert content["model"]["name"] == "mlp"
    assert content["robot"]["command"]["left"]["unit"] == "PWM"
    assert content["situation"] == ["command"]
    assert read_description(saved).provenance == {"seed": 3}
    assert sorted(path.name for path in saved.iterdir()) == ["model.yaml", "weights.safetensors"]


def change_description(folder, **changes):
    path = folder / "model.yaml"
    path.write_text(yaml.safe_dump({**yaml.safe_load(path.read_text()), **changes}))


def refusal(folder):
    with pytest.raises(UserError) as error:
        load_dynamics(folder)
    return str(error.value)


def test_a_folder_without_a_model_is_refused(tmp_path):
    expected = f"no model in {tmp_path}: model.yaml is missing; name a folder that train made"
    assert refusal(tmp_path) == expected


def test_missing_weights_are_named(saved):
    (saved / "weights.safetensors").unlink()
    assert refusal(saved) == f"{saved}/weights.safetensors is missing: train the model anew"


@pytest.mark.parametrize("length", [0, 5, 100, -100])
def test_truncated_weights_are_damaged(saved, length):
    path = saved / "weights.safetensors"
    path.write_bytes(path.read_bytes()[:length])
    assert refusal(saved).startswith(f"{path} is damaged (")


def test_weights_of_another_model_are_refused(saved):
    change_description(saved, model={"name": "mlp", "layers": [64, 64]})
    expected = f"{saved}/weights.safetensors does not belong to model.yaml beside it: train the model anew"
    assert refusal(saved) == expected
    change_description(saved, model={"name": "crnet"})
    assert refusal(saved) == expected


def test_weights_that_are_not_finite_are_refused(robots, tmp_path):
    dynamics = NetworkDynamics(robots["mgr"], config_class("mlp")())
    with torch.no_grad():
        dynamics.network[0].bias[3] = torch.nan
    save_dynamics(tmp_path, dynamics, {})
    assert refusal(tmp_path) == f"{tmp_path}/weights.safetensors: network.0.bias is not finite; train the model anew"


@pytest.mark.parametrize("name", ["model.yaml", "weights.safetensors"])
def test_a_folder_in_place_of_a_file_is_refused(saved, name):
    (saved / name).unlink()
    (saved / name).mkdir()
    assert refusal(saved) == f"{saved}/{name} is a folder and should be a file: train the model anew"


def test_a_situation_that_is_not_the_models_is_refused(saved):
    change_description(saved, situation=["command", "pose"])
    assert refusal(saved) == (
        f"{saved}/model.yaml: situation: command, pose is not what its model looks at: command; train the model anew"
    )


def test_an_unknown_model_or_field_is_refused(saved):
    change_description(saved, model={"name": "mlpp"})
    assert refusal(saved).startswith("no such dynamics model: 'mlpp': did you mean 'mlp'?")
    change_description(saved, model={"name": "mlp", "_target_": "os.system"})
    assert refusal(saved).startswith(f"{saved}/model.yaml: model: unknown field '_target_'")


def test_nothing_in_the_description_is_executed(saved, tmp_path):
    (saved / "model.yaml").write_text(f"!!python/object/apply:os.mkdir ['{tmp_path}/executed']")
    assert refusal(saved).startswith(f"{saved}/model.yaml is damaged: ")
    assert not (tmp_path / "executed").exists()


def test_a_format_of_the_future_is_refused(saved):
    change_description(saved, format=2)
    assert refusal(saved) == f"{saved}/model.yaml: format 2 is not known here: update swarmtwin, or train anew"
