import dataclasses

import numpy as np
import pytest
import torch

from swarmtwin.dynamics.evaluation import (
    ErrorFigure,
    floor,
    model_error,
    neighbour_prediction,
    one_step,
    predict,
)
from swarmtwin.dynamics.model_config import config_class
from swarmtwin.dynamics.predictor import NetworkDynamics
from swarmtwin.errors import UserError
from swarmtwin.learning.nearest_neighbours import NeighbourRegression
from swarmtwin.learning.situation import Situation
from toy import exact_displacement, toy_transitions


@pytest.fixture(scope="module")
def dynamics(robots):
    torch.manual_seed(0)
    return NetworkDynamics(robots["mgr"], config_class("kinematic")()).eval()


def test_errors_by_hand():
    measured = np.array([[0.0, 0.0, 0.0], [10.0, 0.0, 3.1]])
    predicted = np.array([[3.0, 4.0, 0.1], [10.0, 0.0, -3.1]])
    figure = ErrorFigure.between(predicted, measured)
    around_the_half_turn = 2 * np.pi - 6.2
    assert figure.position_mm == pytest.approx(2.5)
    assert figure.position_sd_mm == pytest.approx(2.5)
    assert figure.orientation_deg == pytest.approx(np.degrees((0.1 + around_the_half_turn) / 2))
    assert figure.orientation_sd_deg == pytest.approx(np.degrees((0.1 - around_the_half_turn) / 2))
    assert figure.transitions == 2


def test_no_transitions_are_refused(robots, dynamics):
    empty = toy_transitions(robots["mgr"], 50).where(np.zeros(50, bool))
    with pytest.raises(
        UserError, match="there are no transitions to evaluate: record more runs, or split them otherwise"
    ):
        one_step(dynamics, empty)


def test_floor_and_model_error_add_up_to_the_one_step_error(robots, dynamics):
    transitions = toy_transitions(robots["mgr"], 20_000, noise=(2.0, 2.0, 0.05))
    exact = exact_displacement(transitions.command)
    assert one_step(dynamics, transitions) == ErrorFigure.between(
        predict(dynamics, transitions), transitions.displacement
    )
    # squared errors add up, since the noise is independent of what the model gets wrong
    squares = [
        figure.position_mm**2 + figure.position_sd_mm**2
        for figure in (
            one_step(dynamics, transitions),
            floor(exact, transitions),
            model_error(dynamics, transitions, exact),
        )
    ]
    assert squares[0] == pytest.approx(squares[1] + squares[2], rel=0.02)


def test_the_floor_of_known_noise_is_that_of_its_distribution(robots):
    transitions = toy_transitions(robots["mgr"], 20_000, noise=(2.0, 2.0, 0.05))
    figure = floor(exact_displacement(transitions.command), transitions)
    # Rayleigh and half-normal means; four standard errors of 20,000 draws are 1.5 and 2.2 %
    assert figure.position_mm == pytest.approx(2 * np.sqrt(np.pi / 2), rel=0.015)
    assert figure.orientation_deg == pytest.approx(np.degrees(0.05 * np.sqrt(2 / np.pi)), rel=0.022)


def neighbour_floor(dynamics, transitions, scored=None):
    """The error of predictions from nearest neighbours, which are given what a model is given."""
    with torch.inference_mode():
        inputs = dynamics.encoding(Situation.from_transitions(transitions, dynamics.inputs)).numpy().astype(float)
    scored = np.ones(len(transitions), bool) if scored is None else scored
    predicted, _ = neighbour_prediction(inputs, transitions, scored)
    return ErrorFigure.between(predicted[scored], transitions.displacement[scored])


def test_neighbours_estimate_a_known_floor(robots, dynamics):
    transitions = toy_transitions(robots["mgr"], 8000, noise=(2.0, 2.0, 0.05))
    exact = floor(exact_displacement(transitions.command), transitions).position_mm
    estimate = neighbour_floor(dynamics, transitions)
    assert exact <= estimate.position_mm < 1.05 * exact


def test_a_floor_can_be_estimated_for_some_transitions_only(robots, dynamics):
    transitions = toy_transitions(robots["mgr"], 4000, noise=(2.0, 2.0, 0.05))
    noisier = transitions.displacement.copy()
    scored = transitions.split == 2
    noisier[scored] += np.random.default_rng(1).normal(0, 4, (scored.sum(), 3)) * [1, 1, 0]
    mixed = dataclasses.replace(transitions, displacement=noisier)
    estimate = neighbour_floor(dynamics, mixed, scored)
    assert estimate.transitions == scored.sum()
    assert estimate.position_mm == pytest.approx(np.hypot(2, 4) * np.sqrt(np.pi / 2), rel=0.1)


def test_a_floor_does_not_depend_on_how_the_runs_are_numbered(robots, dynamics):
    transitions = toy_transitions(robots["mgr"], 2000, noise=(2.0, 2.0, 0.05))
    spread = dataclasses.replace(transitions, run=5 * transitions.run + 3)
    assert neighbour_floor(dynamics, spread) == neighbour_floor(dynamics, transitions)


def test_a_floor_from_too_few_transitions_is_refused(robots, dynamics):
    transitions = toy_transitions(robots["mgr"], 50)
    for count in (1, 3):
        with pytest.raises(UserError) as error:
            neighbour_floor(dynamics, transitions.where(np.arange(50) < count))
        assert str(error.value) == (
            f"the floor cannot be estimated from {count} transitions of a vehicle: 2 inputs need at least 4; "
            "record more runs"
        )
    assert np.isfinite(neighbour_floor(dynamics, transitions.where(np.arange(50) < 4)).position_mm)


def test_a_plane_is_regressed_exactly_up_to_the_ridge():
    random = np.random.default_rng(0)
    inputs = random.uniform(-1, 1, (2000, 3))
    outputs = inputs @ random.normal(size=(3, 2)) + 5
    inner = inputs[np.abs(inputs).max(axis=1) < 0.5]
    expected = outputs[np.abs(inputs).max(axis=1) < 0.5]
    predicted = NeighbourRegression(inputs, outputs).predict(inner, 50)
    assert np.abs(predicted - expected).max() < 0.05 * outputs.std()


def test_pooled_figures_are_those_of_all_transitions(robots, dynamics):
    transitions = toy_transitions(robots["mgr"], 400, noise=(2.0, 2.0, 0.05))
    first = np.arange(400) < 100
    parts = [one_step(dynamics, transitions.where(chosen)) for chosen in (first, ~first)]
    assert ErrorFigure.pooled(parts) == pytest.approx(one_step(dynamics, transitions))
