import numpy as np
import pytest
import torch
import yaml
from torch import nn

from swarmtwin.dynamics.model_config import config_class, model_config, model_names
from swarmtwin.dynamics.models.crnet import CRNet
from swarmtwin.dynamics.predictor import NetworkDynamics
from swarmtwin.dynamics.training_module import TrainingModule
from swarmtwin.errors import UserError
from swarmtwin.learning.batches import tensor_splits
from swarmtwin.learning.situation import Situation
from swarmtwin.robot import Arena
from toy import CONF, recipe, toy_transitions

ROBOTS = sorted(path.stem for path in (CONF / "robot").glob("*.yaml"))


def arbitrary_mean(command):
    scaled = command / np.abs(command).max(axis=0)
    return np.column_stack([20 * scaled[:, 0], 5 * scaled[:, 1], 0.3 * scaled[:, -1]])


def dynamics_with_data(robot, name, count=600):
    transitions = toy_transitions(robot, count, noise=(2, 2, 0.05), mean=arbitrary_mean)
    torch.manual_seed(0)
    dynamics = NetworkDynamics(robot, config_class(name)())
    data = tensor_splits(transitions, dynamics.inputs)
    dynamics.learn_scaling(*data.train)
    return dynamics, data


def test_files_configurations_and_registry_agree():
    shipped = {path.stem: yaml.safe_load(path.read_text())["name"] for path in (CONF / "model").glob("*.yaml")}
    assert set(shipped.values()) == set(model_names())
    assert set(model_names()) <= set(shipped)
    variants = {word: name for word, name in shipped.items() if word != name}
    assert all(word.startswith(f"{name}_") for word, name in variants.items()), "a variant is named after its model"
    assert all(config_class(name).model_fields["name"].default == name for name in model_names())


@pytest.mark.parametrize("name", model_names())
def test_yaml_and_python_give_the_same_configuration(name):
    path = CONF / "model" / f"{name}.yaml"
    content = yaml.safe_load(path.read_text())
    assert model_config(content, str(path)) == config_class(name)()
    assert set(content) == set(config_class(name).model_fields)


def test_an_unknown_model_is_refused_with_the_near_miss():
    with pytest.raises(UserError) as error:
        config_class("crnett")
    assert str(error.value) == (
        f"no such dynamics model: 'crnett': did you mean 'crnet'? known: {', '.join(model_names())}"
    )


def test_an_unknown_field_is_refused_with_the_near_miss():
    with pytest.raises(UserError, match=r"^x: unknown field 'dropuot': did you mean 'dropout'\?"):
        model_config({"name": "crnet", "dropuot": 0.2}, "x")


def test_a_configuration_without_a_name_is_refused():
    with pytest.raises(UserError, match=r"^x: field 'name' is missing: it says which dynamics model; known: boosted"):
        model_config({"dropout": 0.2}, "x")


@pytest.mark.parametrize("name", model_names())
@pytest.mark.parametrize(
    "wrong",
    [{"steps": 0}, {"learning_rate": -1}, {"learning_rate": 0}, {"situation": []}, {"situation": ["pose"]}],
    ids=str,
)
def test_no_model_loosens_what_all_have_in_common(name, wrong):
    with pytest.raises(UserError, match=f"^x: field '{next(iter(wrong))}"):
        model_config({"name": name, **wrong}, "x")


def test_a_situation_without_the_command_is_refused_and_told_what_to_do():
    with pytest.raises(UserError) as error:
        model_config({"name": "mlp", "situation": ["pose"]}, "model")
    assert str(error.value) == (
        "model: field 'situation': Value error, situation must contain 'command', "
        "or be null for that of the robot's file"
    )


@pytest.mark.parametrize(
    ("name", "wrong"),
    [("mlp", {"layers": []}), ("mlp", {"layers": [128, 0]})]
    + [(name, wrong) for name in ("lstm", "gru") for wrong in ({"layers": []}, {"layers": [0]}, {"hidden": 0})],
)
def test_layers_without_width_are_refused(name, wrong):
    with pytest.raises(UserError, match=f"^x: field '{next(iter(wrong))}"):
        model_config({"name": name, **wrong}, "x")


@pytest.mark.parametrize(
    ("name", "parameters"),
    [
        *[("crnet", 95_511), ("fcnn", 126_019), ("cnn", 59_275), ("lstm", 64_483), ("gru", 54_979)],
        *[("fcnn_repaired", 126_019), ("cnn_repaired", 48_027)],
    ],
)
def test_parameter_counts_are_the_published_ones(robots, name, parameters):
    dynamics = NetworkDynamics(robots["mgr"], config_class(name)())
    assert sum(parameter.numel() for parameter in dynamics.parameters()) == parameters


@pytest.mark.parametrize("robot", ROBOTS)
@pytest.mark.parametrize("name", model_names())
def test_the_loss_reaches_every_parameter(robots, name, robot):
    dynamics, data = dynamics_with_data(robots[robot], name)
    with torch.no_grad():
        for parameter in dynamics.parameters():  # away from symmetric beginnings
            parameter += 0.05 * torch.randn_like(parameter)
    sum(TrainingModule(dynamics, recipe(), steps=1).errors(data.train)).backward()
    assert not [name for name, parameter in dynamics.named_parameters() if not parameter.grad.abs().max() > 0]
    assert all(parameter.grad.isfinite().all() for parameter in dynamics.parameters())


@pytest.mark.parametrize("name", ["crnet", "cnn", "lstm", "gru"])
def test_outputs_stay_within_the_range_of_the_training_data(robots, name):
    dynamics, data = dynamics_with_data(robots["mgr"], name)
    situation, displacement = data.train
    low, high = displacement.min(dim=0).values, displacement.max(dim=0).values
    predicted = dynamics.eval()(situation)
    assert (predicted >= low).all()
    assert (predicted <= high).all()


class PlainConvolutions(nn.Module):
    """CR-Net's convolutions and LSTM as published, of torch's own layers on (batch, channels, length)."""

    def __init__(self, network):
        super().__init__()
        first, second = network.convolutions
        self.layers = nn.Sequential(
            nn.Conv1d(1, 8, 1, padding=1),
            nn.BatchNorm1d(8),
            nn.LeakyReLU(0.01),
            nn.Conv1d(8, 64, 1, padding=1),
            nn.BatchNorm1d(64),
            nn.LeakyReLU(0.01),
        )
        for convolution, ours in ((self.layers[0], first), (self.layers[3], second)):
            convolution.weight = nn.Parameter(ours.convolution.weight.detach().clone()[..., None])
            convolution.bias = nn.Parameter(ours.convolution.bias.detach().clone())
        self.lstm = nn.LSTM(network.lstm.input_size, 5, batch_first=True)
        self.lstm.load_state_dict(network.lstm.state_dict())

    def forward(self, values):
        return self.lstm(self.layers(values[:, None]))[0].flatten(1)


@pytest.mark.parametrize("inputs", [2, 6])
def test_crnet_computes_what_the_plain_published_layers_compute(inputs):
    torch.manual_seed(0)
    network = CRNet(inputs, dropout=0.0).double()
    plain = PlainConvolutions(network).double()
    values = torch.rand(64, inputs, dtype=torch.float64)

    def ours(values):
        return network.lstm(network.convolutions(values[None]))[0].transpose(0, 1).flatten(1)

    for _ in range(3):
        torch.testing.assert_close(ours(values), plain(values))
    ours(values).square().sum().backward()
    plain(values).square().sum().backward()
    torch.testing.assert_close(network.convolutions[0].convolution.weight.grad, plain.layers[0].weight.grad[..., 0])
    network.eval()
    plain.eval()
    torch.testing.assert_close(ours(values), plain(values))


def test_crnet_has_the_published_skips():
    torch.manual_seed(0)
    network = CRNet(2, dropout=0.0).eval()
    seen = {}
    for number, layer in enumerate(network.layers, start=1):
        layer.register_forward_hook(
            lambda _, given, returned, number=number: seen.update({number: (given[0], returned)})
        )
    network(torch.rand(8, 2))
    torch.testing.assert_close(seen[6][0], seen[5][1] + seen[3][1])
    torch.testing.assert_close(seen[7][0], seen[6][1] + seen[2][1])


def test_a_model_looks_at_nothing_but_the_parts_it_asks_for(robots):
    dynamics, data = dynamics_with_data(robots["mgr"], "mlp")
    situation, _ = data.train
    alone = situation.only(("command",))
    assert torch.equal(dynamics(alone), dynamics(situation))
    with pytest.raises(ValueError, match="the situation has no pose: give it one"):
        alone.only(("command", "pose"))


def test_a_network_given_the_walls_keeps_the_arena_that_it_learned_in(robots):
    mur = robots["mur"]
    elsewhere = Arena(x=(7000, 9000), y=(-500, 500))
    config = config_class("mlp")(wall_reaches=(0.125, 0.03125))
    dynamics = NetworkDynamics(mur, config)
    situation = Situation(command=torch.zeros(2, 3), pose=torch.tensor([[8990.0, 0.0, 0.0], [8000.0, 0.0, 0.0]]))
    dynamics.learn_scaling(situation, torch.randn(2, 3), elsewhere)
    loaded = NetworkDynamics.with_weights(mur, config, dynamics.state_dict())
    torch.testing.assert_close(loaded.encoding.walls_mm, torch.tensor([[7000.0, -500], [9000, 500]]))
    torch.testing.assert_close(loaded.predict(situation), dynamics.eval().predict(situation))
    plain = NetworkDynamics(mur, config_class("mlp")())
    assert dynamics.encoding.width == plain.encoding.width + 10


def test_in_training_each_situation_is_answered_by_one_member_of_the_ensemble_and_later_by_all(robots):
    network = config_class("ensemble")(members=3).build(robots["mgr"], 2)
    inputs = torch.randn(7, 2)
    each = network.perceptrons(inputs)
    alone = network.train()(inputs)
    torch.testing.assert_close(alone, torch.stack([each[row % 3, row] for row in range(7)]))
    torch.testing.assert_close(network.eval()(inputs), each.mean(dim=0))


def test_the_published_output_of_fcnn_can_die_and_the_repaired_one_cannot(robots):
    """With every output far below its range no gradient flows any more through the ReLU."""
    gradients = {}
    for name in ("fcnn", "fcnn_repaired"):
        network = config_class(name)().build(robots["mgr"], 2)
        last = [layer for layer in network.modules() if isinstance(layer, nn.Linear)][-1]
        with torch.no_grad():
            last.bias.fill_(-100.0)
        network(torch.rand(16, 2)).square().sum().backward()
        gradients[name] = float(last.weight.grad.abs().sum())
    assert gradients["fcnn"] == 0 < gradients["fcnn_repaired"]


def test_the_published_convolutions_see_one_input_each_and_the_repaired_ones_their_neighbours(robots):
    reach = {}
    for name in ("cnn", "cnn_repaired"):
        torch.manual_seed(0)
        convolutions = config_class(name)().build(robots["mur"], 6).convolutions.eval()
        values = torch.randn(1, 6, requires_grad=True)
        sequence = convolutions(values[None])[:, 0] if name == "cnn" else convolutions(values[:, None])[0]
        sequence[:, sequence.shape[1] // 2].sum().backward()
        reach[name] = int((values.grad != 0).sum())
    assert reach == {"cnn": 1, "cnn_repaired": 6}


@pytest.mark.parametrize(("name", "jumps"), [("fcnn", True), ("fcnn_repaired", False), ("cnn_repaired", False)])
def test_a_repaired_network_sees_no_jump_where_the_heading_does(robots, name, jumps):
    dynamics, _ = dynamics_with_data(robots["mur"], name)
    heading = torch.tensor([torch.pi - 1e-4, -torch.pi + 1e-4])
    situation = Situation(
        command=torch.tensor([[10.0, 30.0, 6.0]]).expand(2, 3),
        pose=torch.stack([torch.full((2,), 900.0), torch.full((2,), 500.0), heading], dim=-1),
    )
    seen = dynamics.encoding(situation)
    assert bool(((seen[0] - seen[1]).abs() > 0.5).any()) == jumps
