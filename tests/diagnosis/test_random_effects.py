"""Random effects are integrated out as the marginal covariance says, written down as one matrix."""

import numpy as np
import pytest
from exact_base import ExactBase, known_noise, session_of

from swarmtwin.diagnosis.likelihood import SessionLikelihood
from swarmtwin.diagnosis.random_effects import RandomEffects, form_effects, unit_effects
from swarmtwin.simulation.mechanism import mechanism_class

COUNT = 20


@pytest.fixture
def rng():
    return np.random.default_rng(6)


@pytest.fixture
def weight(rng):
    return rng.uniform(0.2, 1.0, COUNT)


@pytest.fixture
def directions(rng):
    """Whitened, (3 N, 5)."""
    return rng.normal(size=(3 * COUNT, 5))


@pytest.fixture
def covariance(directions, weight):
    """(3 N, 3 N) of whitened errors, the effects of unit variance and those of weighted transitions wider."""
    return np.diag(1 / np.repeat(weight, 3)) + directions @ directions.T


@pytest.fixture(params=["at once", "extended"])
def effects(request, directions, weight):
    """All five directions at once, or two of them first."""
    if request.param == "at once":
        return RandomEffects.of(directions, weight)
    return RandomEffects.of(directions[:, :2], weight).extended(directions[:, 2:4]).extended(directions[:, 4:])


def test_products_are_those_by_the_marginal_covariance(effects, covariance, rng):
    columns, errors = rng.normal(size=(3 * COUNT, 3)), rng.normal(size=3 * COUNT)
    both = np.column_stack([columns, errors])
    expected = both.T @ np.linalg.solve(covariance, both)
    np.testing.assert_allclose(effects.gram(both), expected, atol=1e-10)
    gram, side = effects.least_squares(columns, errors)
    np.testing.assert_allclose(gram, expected[:3, :3], atol=1e-10)
    np.testing.assert_allclose(side, expected[:3, 3], atol=1e-10)
    np.testing.assert_allclose(columns.T @ effects.beyond(both), expected[:3], atol=1e-10)


def test_sizes_are_the_posterior_mean(effects, directions, covariance, rng):
    errors = rng.normal(size=(COUNT, 3))
    expected = directions.T @ np.linalg.solve(covariance, errors.ravel())
    np.testing.assert_allclose(effects.sizes(errors), expected, atol=1e-10)
    np.testing.assert_allclose(effects.of_sizes(expected).ravel(), directions @ expected, atol=1e-10)


def test_the_determinant_is_that_by_which_the_covariance_grows(effects, covariance, weight):
    grown = np.linalg.slogdet(covariance)[1] + 3 * np.log(weight).sum()
    assert np.isclose(effects.log_determinant, grown)


def explained_by_units(robot, name, **values):
    """The share of what a mechanism changes that the differences between units can take over."""
    base = ExactBase(robot)
    session = session_of(base, np.random.default_rng(2), vehicle="2")
    model = SessionLikelihood(base, known_noise(), session, known_vehicles=("1",))
    columns = np.stack(list(unit_effects(model)), axis=-1).reshape(3 * len(session), -1)
    change = (model.errors([mechanism_class(name).at(values)]) - model.errors([])).ravel()
    left = change - columns @ np.linalg.lstsq(columns, change, rcond=None)[0]
    return 1 - (left @ left) / (change @ change)


def test_units_of_a_fin_differ_in_speed_trim_and_how_far_they_beat(robots):
    assert explained_by_units(robots["mur"], "gain_change", gain=1.05) > 0.99
    assert explained_by_units(robots["mur"], "actuator_asymmetry", angle_rad=0.02) > 0.99
    assert explained_by_units(robots["mur"], "backlash", travel_rad=0.02) > 0.99


def test_units_with_wheels_do_not_differ_by_where_they_are(robots):
    assert explained_by_units(robots["mgr"], "gain_change", gain=1.05) > 0.99
    assert explained_by_units(robots["mgr"], "steady_drift", x_mm_s=2.0, y_mm_s=0.0) < 0.1


@pytest.mark.parametrize(
    ("robot", "cause", "of_values", "share", "axes"),
    [
        ("mgr", {"actuator_lag": {"time_constant_s": 0.1}}, False, 0.05, {0, 2}),
        ("mgr", {"actuator_lag": {"time_constant_s": 0.1}}, True, 0.1, {0, 1, 2}),
        ("mgr", {"backlash": {"travel_mm": 3.0}}, False, 0.05, {0, 2}),
        ("mgr", {"backlash": {"travel_mm": 3.0}}, True, 0.1, {0, 1, 2}),
        ("mur", {"actuator_lag": {"time_constant_s": 0.1}}, False, 0.1, {0, 1, 2}),
    ],
)
def test_how_thrust_follows_is_known_least_as_are_the_values_of_wheels(robots, robot, cause, of_values, share, axes):
    base = ExactBase(robots[robot])
    session = session_of(base, np.random.default_rng(2))
    model = SessionLikelihood(base, known_noise(), session)
    late = [mechanism_class(name).at(values) for name, values in cause.items()]
    change = model.errors(late) - model.errors([])
    alone = list(form_effects(model, late, of_values=of_values))[-len(axes) :]
    for axis, form in zip(sorted(axes), alone, strict=True):
        np.testing.assert_allclose(form[:, axis], share * change[:, axis])
        assert not np.delete(form, axis, axis=1).any()
