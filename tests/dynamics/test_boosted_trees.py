"""Boosted trees: what is kept as arrays predicts what scikit-learn does, and nothing is pickled."""

import numpy as np
import pytest
import torch
from safetensors.torch import load_file
from sklearn.ensemble import HistGradientBoostingRegressor

from swarmtwin.dynamics.evaluation import ErrorFigure, predict
from swarmtwin.dynamics.model_config import config_class
from swarmtwin.dynamics.model_folder import load_dynamics, save_dynamics
from swarmtwin.dynamics.models.boosted_trees import BoostedTrees
from swarmtwin.dynamics.training import train
from toy import exact_displacement, recipe, toy_transitions


def drawn(count, inputs, seed):
    rng = np.random.default_rng(seed)
    return rng.normal(size=(count, inputs)).astype(np.float32).astype(float)


@pytest.mark.parametrize(("leaves", "depth"), [(31, 8), (2, 1), (64, 3)])
def test_the_arrays_predict_what_scikit_learn_does(leaves, depth):
    inputs, asked = drawn(3000, 4, 0), drawn(5000, 4, 1)
    network = BoostedTrees(trees=30, leaves=leaves, depth=depth)
    expected = []
    for component in range(3):
        outputs = np.sin(2 * inputs[:, component]) * inputs[:, 3] + inputs[:, 0] + component
        regressor = HistGradientBoostingRegressor(
            max_iter=[30, 7, 1][component], max_leaf_nodes=leaves, max_depth=depth, early_stopping=False
        ).fit(inputs, outputs)
        network.take(component, regressor)
        expected.append(regressor.predict(asked))
    predicted = network(torch.as_tensor(asked, dtype=torch.float32)).detach().numpy()
    np.testing.assert_allclose(predicted, np.column_stack(expected), atol=2e-5)


def test_a_value_on_a_threshold_goes_left_as_in_scikit_learn():
    inputs = np.repeat([0.0, 1.0], 50)[:, None]
    regressor = HistGradientBoostingRegressor(max_iter=1, learning_rate=1.0).fit(inputs, inputs[:, 0])
    network = BoostedTrees(trees=1, leaves=31, depth=8)
    network.take(0, regressor)
    threshold = regressor._predictors[0][0].nodes["num_threshold"][0]
    asked = np.array([[threshold], [np.nextafter(np.float32(threshold), np.float32(2))]])
    predicted = network(torch.as_tensor(asked, dtype=torch.float32)).detach().numpy()[:, 0]
    np.testing.assert_allclose(predicted, regressor.predict(asked), atol=1e-6)
    assert predicted[0] < predicted[1]


def test_trees_that_were_not_grown_say_nothing():
    assert not BoostedTrees(trees=5, leaves=8, depth=3)(torch.randn(4, 2)).any()


@pytest.fixture(scope="module")
def trained(robots):
    transitions = toy_transitions(robots["mgr"], 6000, noise=(1.0, 1.0, 0.03))
    return transitions, train(transitions, config_class("boosted_trees")(steps=200), recipe(), [1])


def test_trees_learn_the_toy(trained):
    transitions, result = trained
    unseen = toy_transitions(transitions.robot, 2000, seed=99)
    error = ErrorFigure.between(predict(result.dynamics, unseen), exact_displacement(unseen.command))
    constant = np.linalg.norm(unseen.displacement[:, :2] - unseen.displacement[:, :2].mean(axis=0), axis=1).mean()
    assert error.position_mm < 0.12 * constant


def test_growing_ends_where_the_validation_runs_gain_nothing(trained):
    """The history has one entry, and trees beyond the last that helped are empty."""
    _, result = trained
    assert len(result.best.history) == 1
    leaf_value = result.dynamics.network.leaf_value.reshape(3, 200, -1)
    grown = leaf_value.abs().amax(dim=-1) > 0
    assert (grown.sum(dim=1) < 200).all()


def test_the_same_data_give_the_same_trees_whatever_the_recipe(trained):
    transitions, result = trained
    again = train(transitions, config_class("boosted_trees")(steps=200), recipe("paper"), [1])
    assert all(np.array_equal(again.best.weights[name], values) for name, values in result.best.weights.items())


def test_a_folder_of_trees_is_plain_numbers(trained, tmp_path):
    transitions, result = trained
    save_dynamics(tmp_path, result.dynamics, {})
    assert sorted(path.name for path in tmp_path.iterdir()) == ["model.yaml", "weights.safetensors"]
    assert {name.split(".")[0] for name in load_file(tmp_path / "weights.safetensors")} == {
        *("encoding", "network", "output_scaling")
    }
    assert np.array_equal(predict(load_dynamics(tmp_path), transitions), predict(result.dynamics, transitions))
