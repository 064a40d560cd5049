"""What nobody could predict is estimated from what models leave, and never above it."""

import dataclasses

import numpy as np
import pytest

from swarmtwin.dynamics.evaluation import ErrorFigure
from swarmtwin.simulation.estimated_floor import estimated_floor
from toy import exact_displacement, toy_transitions

NOISE = (2.0, 2.0, 0.05)


def exact(transitions):
    return exact_displacement(transitions.command)


def wavy(transitions):
    """The exact displacement and a smooth error."""
    waves = np.sin(transitions.command @ np.array([[0.02, 0.01, 0.0], [0.0, 0.02, 0.03]]))
    return exact(transitions) + waves * [3.0, 3.0, 0.1]


def measured(transitions, *models):
    return estimated_floor(transitions, ("command",), [model(transitions) for model in models])


@pytest.fixture(scope="module")
def transitions(robots):
    return toy_transitions(robots["mgr"], 4000, noise=NOISE)


def test_a_smooth_error_of_the_model_is_not_in_the_floor(transitions):
    known = ErrorFigure.between(exact(transitions), transitions.displacement)
    found = measured(transitions, wavy)
    assert ErrorFigure.between(wavy(transitions), transitions.displacement).position_mm > 1.2 * known.position_mm
    # what is left has not quite the shape of noise: a wave's mean is nearer to its root mean square
    assert found.error.position_mm == pytest.approx(known.position_mm, rel=0.04)
    assert found.error.orientation_deg == pytest.approx(known.orientation_deg, rel=0.06)
    assert found.position_mm[0] < found.error.position_mm < found.position_mm[1]


def test_of_several_models_each_error_is_that_of_the_better_one(transitions):
    def turned(transitions):
        return exact(transitions) + np.array([0.0, 0.0, 0.2])

    def shifted(transitions):
        return exact(transitions) + np.array([5.0, 0.0, 0.0])

    both, one = measured(transitions, turned, shifted), measured(transitions, exact)
    assert both.error.position_mm == pytest.approx(one.error.position_mm)
    assert both.error.orientation_deg == pytest.approx(one.error.orientation_deg)


def test_the_floor_is_never_above_a_model(transitions):
    error = ErrorFigure.between(exact(transitions), transitions.displacement)
    found = measured(transitions, exact)
    assert found.error.position_mm <= error.position_mm
    assert found.position_mm[1] <= error.position_mm
    assert found.orientation_deg[1] <= error.orientation_deg


def test_of_few_transitions_nothing_is_known_but_the_models_error(transitions):
    few = transitions.where(np.arange(len(transitions)) < 9)
    found = measured(dataclasses.replace(few), exact)
    error = ErrorFigure.between(exact(few), few.displacement)
    assert found.error == error
    assert found.position_mm == (0.0, error.position_mm)
