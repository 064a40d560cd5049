"""What is left over alarms where the simulation is sure of itself, and not where it was learned from too little."""

import numpy as np
import pytest
import torch
from exact_base import ExactBase, as_simulated, errors_showing, known_noise, session_of
from uncertain_base import likelihood

from swarmtwin.diagnosis.cause_search import CauseSearch
from swarmtwin.diagnosis.estimation import estimate
from swarmtwin.diagnosis.explanation import explanation
from swarmtwin.diagnosis.left_over import left_over, nats_of_uncertainty
from swarmtwin.diagnosis.likelihood import SessionLikelihood
from swarmtwin.diagnosis.noise import log_density
from swarmtwin.diagnosis.reference_errors import ReferenceErrors
from swarmtwin.geometry import exp_map


def explained(model):
    return explanation(model, CauseSearch(model, {}, None).run())


@pytest.mark.parametrize("robot", ["mgr", "mur"])
def test_what_an_uncertain_simulation_gets_wrong_is_no_gap(robots, robot):
    found = explained(likelihood(robots[robot], sure=False))
    assert found.left.by_situation > found.alarm  # a regression finds it
    assert found.left.by_situation < found.alarm + found.left.most_uncertainty
    assert not found.is_something_left
    assert found.verdict == "no_gap"


@pytest.mark.parametrize("robot", ["mgr", "mur"])
def test_the_same_error_of_a_simulation_that_is_sure_is_a_gap(robots, robot):
    found = explained(likelihood(robots[robot], sure=True))
    assert found.left.most_uncertainty < found.left.by_situation - found.alarm
    assert found.verdict == "unexplained"


def test_a_gap_beyond_the_uncertainty_alarms(robots):
    def slower(moment):
        return exp_map(moment.way * (1 - 0.3 * torch.cos(3 * moment.pose[:, :1] / 400)))

    found = explained(likelihood(robots["mgr"], sure=False, moved=slower))
    assert found.verdict == "unexplained"


def test_a_simulation_of_one_member_is_taken_as_certain(robots):
    base = ExactBase(robots["mgr"])
    model = SessionLikelihood(base, known_noise(), session_of(base, np.random.default_rng(1)))
    assert not nats_of_uncertainty(model, model.evaluate([]), model.disagreement, 3).any()


def test_what_depends_on_little_is_not_drowned_by_all_that_errors_might_depend_on(robots):
    """A floor that is brushed one way: vehicles go 1 % farther along it and less against it."""

    def brushed(moment):
        along = torch.cos(moment.pose[:, 2:] - 0.7)
        return exp_map(moment.way * torch.cat([1 + 0.014 * along, torch.ones_like(along), torch.ones_like(along)], 1))

    model = likelihood(robots["mgr"], sure=True, moved=brushed, size=0.0)
    found, nothing = explained(model), model.evaluate([])
    errors = model.errors_left([]) - nothing.effect_errors
    predicted = model.flexible.predicted(errors, model.noise.spread(model.motion), model.weight)
    residual = model.filter(np.stack([errors, errors - predicted], axis=-1)) / nothing.scale[:, None]
    by_everything = np.diff([log_density(one, None).sum() for one in np.moveaxis(residual, -1, 0)])[0]
    assert by_everything < found.alarm < found.left.by_situation
    assert found.verdict == "unexplained"


def test_ground_on_which_vehicles_go_farther_along_than_across_is_seen(robots):
    def brushed(moment):
        return exp_map(moment.way * (1 + 0.06 * torch.cos(2 * (moment.pose[:, 2:] - 0.4))))

    found = {}
    for name, moved in (("brushed", brushed), ("even", as_simulated)):
        session = session_of(ExactBase(robots["mgr"]), np.random.default_rng(8), moved)
        model = SessionLikelihood(ExactBase(robots["mgr"]), known_noise(), session)
        found[name] = left_over(model, estimate(model, []), 0.0, ReferenceErrors()).by_situation
    assert found["brushed"] > 40
    assert found["even"] < 5


@pytest.mark.parametrize(("by_history", "asks_reference"), [(6.0, False), (10.0, True)])
def test_what_the_reference_shows_of_history_is_taken_off_where_it_could_forbid_a_name(
    robots, monkeypatch, by_history, asks_reference
):
    """Errors that follow each other as much in the reference say nothing against a cause."""
    monkeypatch.setattr("swarmtwin.diagnosis.left_over.nats_by_history", lambda *_: by_history)
    model = likelihood(robots["mgr"], sure=True, size=0.0)
    usual = errors_showing(nats_by_history=10.0 / len(model.session), transitions=len(model.session))
    left = left_over(model, estimate(model, []), 0.0, usual)
    assert (left.by_history < 0) is asks_reference
    assert asks_reference or left.by_history == by_history
