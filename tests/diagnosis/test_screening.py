"""Where the search for a cause begins: nowhere worse than where it was looked at, in a part of a long session."""

import numpy as np
import pytest
import torch
from exact_base import ExactBase, known_noise, session_of
from simulated_session import simulated_noise, simulated_session

from swarmtwin.diagnosis.cause_search import CauseSearch
from swarmtwin.diagnosis.likelihood import SessionLikelihood
from swarmtwin.diagnosis.screening import best_by_name, candidates, pairs
from swarmtwin.geometry import exp_map
from swarmtwin.simulation.mechanism import mechanism_class


def without_small_commands(width_deg, rest):
    """Amplitudes below a width do nothing, and everything else is weaker as well."""

    def moved(moment):
        command = moment.command.clone()
        command[:, 1] = torch.where(command[:, 1] < width_deg, torch.zeros_like(command[:, 1]), command[:, 1])
        return exp_map(moment.base.twist(command) * rest)

    return moved


@pytest.mark.parametrize("rest", [1.0, 0.9])
def test_a_search_begins_where_the_session_is_at_least_as_likely_as_on_its_grid(robots, rest):
    base = ExactBase(robots["mur"])
    session = session_of(base, np.random.default_rng(3), without_small_commands(22.3, rest))
    model = SessionLikelihood(base, known_noise(), session)
    nothing, kind = model.evaluate([]), mechanism_class("dead_band")
    on_grid = [model.evaluate([kind.at(point)]).total for point in kind.initial_points(model.robot, session.conditions)]
    found = candidates(model, nothing, {"dead_band": kind})
    best = best_by_name(model, nothing, found, most=1)[0]
    assert model.evaluate(best.start).total > max(on_grid) - 1.0
    assert abs(best.start[0].width - 22.3) < 2.0


def test_beside_others_the_points_are_looked_at_again_that_promised_most_alone(robots):
    base = ExactBase(robots["mur"])
    session = session_of(base, np.random.default_rng(3), without_small_commands(22.3, 0.9))
    model = SessionLikelihood(base, known_noise(), session)
    kinds = {name: mechanism_class(name) for name in ("dead_band", "gain_change")}
    alone = candidates(model, model.evaluate([]), kinds)
    weaker = model.evaluate([kinds["gain_change"].at({"gain": 0.9})])
    again = candidates(model, weaker, kinds, alone)
    anew = candidates(model, weaker, kinds)
    bands = [[one for one in found if one.form is anew[0].form] for found in (alone, anew, again)]
    assert len(bands[0]) == len(bands[1]) > 20 > len(bands[2]) == model.settings.search.tried_points
    assert max(bands[1], key=lambda one: one.nats).point in [one.point for one in bands[2]]
    best = best_by_name(model, weaker, again, most=1)[0]
    assert best.name == "dead_band"
    assert abs(best.start[-1].width - 22.3) < 2.0


def test_a_point_that_would_do_the_opposite_takes_no_place_of_one_that_promises_something(robots):
    """A band has no width below zero, however much a linear step to it would gain."""
    base = ExactBase(robots["mur"])
    session = session_of(base, np.random.default_rng(3), without_small_commands(8.0, 1.1))
    model = SessionLikelihood(base, known_noise(), session)
    kinds = {one: mechanism_class(one) for one in ("dead_band", "saturation")}
    limited = model.evaluate([kinds["saturation"].at({"limit": 40.0})])
    alone = candidates(model, model.evaluate([]), kinds)
    found, anew = (
        best_by_name(model, limited, candidates(model, limited, kinds, known), most=1)[0] for known in (alone, ())
    )
    assert found.nats > 0.95 * anew.nats > 50


def test_pairs_begin_where_each_of_both_leads_to(robots):
    base = ExactBase(robots["mur"])
    session = session_of(base, np.random.default_rng(3), without_small_commands(22.3, 0.9))
    model = SessionLikelihood(base, known_noise(), session)
    kinds = {name: mechanism_class(name) for name in ("dead_band", "gain_change", "camera_scale")}
    nothing = model.evaluate([])
    found = pairs(model, nothing, candidates(model, nothing, kinds), most=2)
    likeliest = set(found[0].name.split("+"))
    assert likeliest in (
        {"dead_band", "gain_change"},
        {"dead_band", "camera_scale"},
    )
    assert len(found) == 2
    band = next(one for one in found[0].start if one.name == "dead_band")
    assert abs(band.width - 22.3) < 3.0


WEAKER_AND_LATE = [
    mechanism_class("gain_change").at({"gain": 0.9}),
    mechanism_class("command_delay").at({"delay_s": 0.05}),
]
OFFERED = {name: mechanism_class(name) for name in ("gain_change", "command_delay", "marker_yaw", "camera_scale")}


@pytest.fixture(scope="module")
def long_session(robots):
    session = simulated_session(robots["mgr"], WEAKER_AND_LATE, 5, runs=90)
    return SessionLikelihood(ExactBase(robots["mgr"]), simulated_noise(), session)


def test_what_is_screened_in_a_part_of_the_runs_is_estimated_in_all(long_session):
    part = long_session.thinned(900)
    whole = CauseSearch(long_session, OFFERED).run()
    found = CauseSearch(long_session, OFFERED, screened=part).run()
    assert set(found.best.names) == set(whole.best.names) == {"gain_change", "command_delay"}
    assert len(found.best.fitted.residual) == len(long_session.session) > 2 * len(part.session)
    error = np.sqrt(np.diag(whole.best.covariance))
    in_order = [whole.best.names.index(name) for name in found.best.names]
    np.testing.assert_allclose(found.best.values, whole.best.values[in_order], atol=0.1 * error.max())
    assert len(found.sets) < len(whole.sets)  # what is far behind in the part is not fitted to all


def test_each_part_of_the_best_set_is_fitted_to_all_as_it_is_asked_about(long_session):
    found = CauseSearch(long_session, OFFERED, screened=long_session.thinned(900)).run()
    for name in found.best.names:
        assert found.of_names([name]) is not None
        assert found.is_likelier_than_nothing([name])


def test_a_part_of_a_session_has_whole_runs_with_the_errors_that_they_have_in_all_of_it(long_session):
    part, rows = long_session.thinned(900), long_session.session.spread_over(900)
    assert 0.2 * len(rows) < rows.sum() < 0.5 * len(rows)
    late = WEAKER_AND_LATE[1:]
    np.testing.assert_allclose(part.errors(late), long_session.errors(late)[rows], atol=1e-9)
    runs = long_session.session.run
    assert set(runs[rows]).isdisjoint(runs[~rows])
    assert long_session.thinned(len(rows)) is long_session
