"""Which commands arrived is summed over: the compiled sum equals one over every course of a short run."""

from dataclasses import replace
from itertools import product

import numpy as np
import pytest
from exact_base import ExactBase, Losing, errors_showing, known_noise, session_of

from swarmtwin.diagnosis.cause_search import CauseSearch
from swarmtwin.diagnosis.estimation import estimate
from swarmtwin.diagnosis.explanation import beyond_usual_loss
from swarmtwin.diagnosis.likelihood import SessionLikelihood
from swarmtwin.diagnosis.lost_commands import Ages, _log_density, _tables
from swarmtwin.diagnosis.noise_filter import Chains
from swarmtwin.simulation.mechanism import mechanism_class


def summed_over_courses(emitted, ages):
    """Log density of one run's (n, 2 K), over all ways in which its commands, and the K before them, arrived."""
    total, oldest = 0.0, ages.oldest
    for arrived in product([True, False], repeat=len(emitted) + oldest):
        density = np.prod([ages.arrives if one else 1 - ages.arrives for one in arrived])
        for period, densities in enumerate(emitted):
            past = arrived[period : period + oldest][::-1]  # the last one first
            before = past.index(True) if True in past else oldest
            now = arrived[period + oldest]
            course = ages.after_arrival[before] if now else ages.after_loss[min(before + 1, oldest)]
            density *= np.exp(densities[course])
        total += density
    return np.log(total)


@pytest.mark.parametrize("oldest", [2, 3, 5])
def test_each_run_is_as_likely_as_all_its_courses_together(oldest):
    rng, ages = np.random.default_rng(3), Ages(0.7, oldest)
    emitted, rows = rng.normal(-3.0, 2.0, (11, 2 * oldest)), rng.permutation(11)
    runs = [rows[:5], rows[5:6], rows[6:]]
    density = _log_density(*Chains.of(runs), emitted, *_tables(ages))
    for run in runs:
        assert np.isclose(density[run].sum(), summed_over_courses(emitted[run], ages))


@pytest.mark.parametrize("oldest", [2, 3, 5])
def test_courses_are_numbered_by_how_old_commands_are(oldest):
    ages = Ages(0.6, oldest)
    assert ages.probability.sum() == pytest.approx(1.0)
    assert ages.course_probability.sum() == pytest.approx(1.0)
    courses = {*ages.after_arrival.tolist(), *ages.after_loss[1:].tolist()}
    assert courses == set(range(2 * oldest))
    assert ages.course_probability[:3] == pytest.approx([0.36, 0.24 if oldest == 2 else 0.144, 0.24])


@pytest.mark.parametrize("usual", [0.0, 0.01, 0.2])
def test_what_the_reference_seems_to_lose_as_well_is_no_loss_of_the_session(robots, usual):
    base = ExactBase(robots["mgr"])
    session = session_of(base, np.random.default_rng(2), moved=Losing(0.06, 2), runs=40)
    model = SessionLikelihood(base, known_noise(), session)
    begun = [mechanism_class("gain_change").at({"gain": 1.0}), mechanism_class("command_loss").at({"probability": 0.1})]
    found = estimate(model, begun)
    beyond = beyond_usual_loss(model, found, errors_showing(loss=usual))
    *others, lost = beyond.values
    assert others == list(found.values[:-1])
    also = min(usual, found.values[-1])
    assert 1 - found.values[-1] == pytest.approx((1 - also) * (1 - lost))  # neither way
    assert beyond.mechanisms[-1].probability == lost
    assert beyond.fitted.total == found.fitted.total
    spread, before = (np.sqrt(np.diag(one.covariance)) for one in (beyond, found))
    assert spread[:-1] == pytest.approx(before[:-1])
    assert spread[-1] == pytest.approx(np.hypot(before[-1], also))
    alone = estimate(model, begun[:1])
    assert beyond_usual_loss(model, alone, errors_showing(loss=usual)) is alone


def test_what_the_usual_loss_gains_is_asked_of_each_fit_of_a_set(robots):
    """The same causes with other values gain something else by it."""
    base = ExactBase(robots["mgr"])
    session = session_of(base, np.random.default_rng(2), moved=Losing(0.06, 2), runs=40)
    model = SessionLikelihood(base, known_noise(), session)
    kinds = {name: mechanism_class(name) for name in ("gain_change", "command_loss")}
    begun = [kinds["gain_change"].at({"gain": 1.0}), kinds["command_loss"].at({"probability": 0.1})]
    found = estimate(model, begun)
    poor = replace(found, fitted=model.evaluate([kinds["gain_change"].at({"gain": 0.6}), begun[1]]))
    one, another = (CauseSearch(model, kinds, reference=errors_showing(loss=0.05)) for _ in range(2))
    assert abs(another.score(poor) - one.score(found)) > 1.0
    assert another.score(found) == one.score(found)
