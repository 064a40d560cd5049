"""A vehicle of the reference that is unlike the others is told; equal ones hardly ever are."""

import numpy as np
import pytest
from diagnosis_factories import made_result
from exact_base import ExactBase, known_noise, session_of
from fleet import fleet_session, shown_by

from swarmtwin.diagnosis.likelihood import SessionLikelihood
from swarmtwin.diagnosis.reference import Reference
from swarmtwin.diagnosis.report.sentences import DIFFERENCES, verdict_words
from swarmtwin.diagnosis.settings import UnitSettings
from swarmtwin.diagnosis.unit_spread import unit_changes
from swarmtwin.diagnosis.unlike_units import unlike_units


@pytest.mark.parametrize("units", [3, 5, 10])
def test_of_units_that_differ_as_expected_or_less_hardly_one_is_unlike(units):
    """Of 2,000 references one in a hundred at most, but for chance (0.1 % of the time it is 1.7 % of them)."""
    rng, settings = np.random.default_rng(units), UnitSettings()
    for spread in (0.05, 0.02):
        deviation = rng.uniform(0.001, 0.02, (2000, units, 7))
        values = rng.normal(size=deviation.shape) * np.sqrt(spread**2 + deviation**2)
        said = [bool(unlike_units(one, other**2, settings)) for one, other in zip(values, deviation, strict=True)]
        assert np.mean(said) < 0.017


@pytest.mark.parametrize(("units", "weaker"), [(5, 0.4), (8, 0.25)])
def test_how_weak_a_vehicle_must_be_to_be_told_in_nine_of_ten(units, weaker):
    """In two of seven differences; the others differ by 2 %."""
    rng, deviation = np.random.default_rng(units), np.full((units, 7), 0.005)
    values = rng.normal(size=(300, *deviation.shape)) * 0.02
    values[:, -1, :2] -= weaker
    told = [units - 1 in {unit for unit, _ in unlike_units(one, deviation**2, UnitSettings())} for one in values]
    assert np.mean(told) > 0.9


def test_it_takes_more_than_two_that_show_a_difference():
    values = np.array([[0.0, 0.01], [0.9, 0.0], [np.nan, 0.6]])
    assert unlike_units(values, np.full_like(values, 1e-6), UnitSettings(spread=0.02)) == [(2, 1)]


@pytest.mark.parametrize(
    ("factor", "units", "is_told"), [(0.6, 5, True), (0.6, 8, True), (1.0, 5, False), (0.93, 8, False)]
)
def test_a_vehicle_of_a_reference_with_weak_motors_is_unlike_its_others(robots, factor, units, is_told):
    said = shown_by(*fleet_session(robots["mgr"], units, 0.02, 5, unlike=factor)).unlike
    assert set(said) == ({str(units)} if is_told else set())
    if is_told:
        assert {"ahead", "turn"} & {*said[str(units)]}


def test_a_reference_keeps_who_is_unlike(robots):
    transitions = fleet_session(robots["mgr"], 5, 0.02, 5, unlike=0.6)[1].transitions
    assert set(Reference.learn(transitions, 1).unlike) == {"5"}


@pytest.mark.parametrize("verdict", ["no_gap", "explained"])
def test_who_is_unlike_is_told_whatever_the_verdict(verdict):
    unlike = {"7": ("turn", "left_to_right")}
    said = verdict_words(made_result(verdict, unlike_in_reference=unlike))
    assert "Vehicle 7 of the reference is unlike the others there in how far it turns and how fast its left" in said
    assert "reference_vehicles" in said
    assert "of the reference is unlike" not in verdict_words(made_result(verdict))


@pytest.mark.parametrize("name", ["mgr", "mur", "create"])
def test_all_in_which_units_may_differ_has_words(robots, name):
    base = ExactBase(robots[name])
    session = session_of(base, np.random.default_rng(1), runs=8, steps=5)
    predictor = SessionLikelihood(base, known_noise(), session).predictor
    differences = unit_changes(predictor, predictor.twist(()), session)
    assert {"ahead", "turn"} < set(differences)
    assert set(differences) <= set(DIFFERENCES)
