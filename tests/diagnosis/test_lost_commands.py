"""Which commands arrived is summed over: the compiled sum equals one over every course of a short run."""

from itertools import product

import numpy as np
import pytest
from exact_base import ExactBase, Losing, errors_showing, known_noise, session_of

from swarmtwin.diagnosis.estimation import estimate
from swarmtwin.diagnosis.explanation import beyond_usual_loss
from swarmtwin.diagnosis.likelihood import SessionLikelihood
from swarmtwin.diagnosis.lost_commands import _log_density
from swarmtwin.diagnosis.noise_filter import Chains
from swarmtwin.simulation.mechanism import mechanism_class


def summed_over_courses(emitted, arrives):
    """Log density of one run's (n, 4), over all ways in which its commands, and the two before them, arrived."""
    total = 0.0
    for arrived in product([True, False], repeat=len(emitted) + 2):
        density = np.prod([arrives if one else 1 - arrives for one in arrived])
        for period, densities in enumerate(emitted):
            before, now = arrived[period + 1 : period + 3]
            course = (0 if before else 1) if now else (2 if before else 3)
            density *= np.exp(densities[course])
        total += density
    return np.log(total)


def test_each_run_is_as_likely_as_all_its_courses_together():
    rng = np.random.default_rng(3)
    emitted, rows = rng.normal(-3.0, 2.0, (11, 4)), rng.permutation(11)
    runs = [rows[:5], rows[5:6], rows[6:]]
    density = _log_density(*Chains.of(runs), emitted, 0.7)
    for run in runs:
        assert np.isclose(density[run].sum(), summed_over_courses(emitted[run], 0.7))


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
