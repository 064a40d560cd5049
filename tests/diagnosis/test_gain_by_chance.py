"""What causes gain where nothing but the simulation is uncertain, and which causes show more than that."""

import pytest
import torch
from exact_base import as_simulated
from uncertain_base import likelihood

from swarmtwin.diagnosis.cause_search import CauseSearch
from swarmtwin.diagnosis.estimation import estimate
from swarmtwin.diagnosis.explanation import explanation
from swarmtwin.diagnosis.gain_by_chance import beyond_uncertainty, nats_by_chance
from swarmtwin.diagnosis.left_over import nats_of_uncertainty
from swarmtwin.diagnosis.screening import sought_kinds
from swarmtwin.geometry import exp_map
from swarmtwin.simulation.mechanism import mechanism_class


@pytest.mark.parametrize("robot", ["mgr", "mur"])
def test_causes_gain_less_by_chance_where_the_simulation_is_sure_and_less_than_regressions_do(robots, robot):
    by_chance, by_regression = {}, {}
    for sure in (True, False):
        model = likelihood(robots[robot], sure, size=0.2)
        fitted = model.evaluate([])
        by_chance[sure] = nats_by_chance(model, fitted.residual, 40)
        by_regression[sure] = nats_of_uncertainty(model, fitted, model.disagreement, 12)[:, 0]
    assert by_chance[True].mean() < by_chance[False].mean() < by_regression[False].mean()


def test_what_the_best_cause_gains_by_chance_holds_what_it_gains_of_another_simulation_as_uncertain(robots):
    """Nothing is wrong, but the simulation is: the search gains no more than the bootstrap says that it may."""
    model = likelihood(robots["mgr"], sure=False, size=0.2)
    kinds = {name: kind for name, kind in sought_kinds(model).items() if name in ("gain_change", "dead_band")}
    posterior = CauseSearch(model, kinds, None).run()
    single = [one for one in posterior.sets if len(one.names) == 1]
    gained = max(one.fitted.total for one in single) - posterior.nothing.fitted.total
    drawn = nats_by_chance(model, model.evaluate([]).residual, 100)
    assert gained < drawn.mean() + 3 * drawn.std()


def weakening(moment):
    """By a fifth over the session, of which each run is a part."""
    rows = torch.arange(len(moment.way), dtype=torch.float64)[:, None]
    return exp_map(moment.way * (1 - 0.2 * rows / len(rows)))


STARTS = {
    "battery_sag": {"loss": 0.1, "shape": 1.0},
    "gain_change": {"gain": 0.95},
    "dead_band": {"width": 5.0},
    "saturation": {"limit": 90.0},
    "camera_scale": {"scale": 1.02},
}


def found_with(model, names):
    return estimate(model, [mechanism_class(name).at(STARTS[name]) for name in names]).mechanisms


@pytest.mark.parametrize("beside", [(), ("dead_band",)])
def test_a_battery_is_told_from_what_a_simulation_that_does_not_look_at_the_time_gets_wrong(robots, beside):
    model = likelihood(robots["mgr"], sure=False, moved=weakening, size=2.0)
    assert beyond_uncertainty(model, found_with(model, ("battery_sag", *beside))) == {"battery_sag"}


@pytest.mark.parametrize("seed", range(6))
@pytest.mark.parametrize("names", [(name,) for name in STARTS] + [("battery_sag", "gain_change")])
def test_no_cause_shows_more_than_an_uncertain_simulation_where_nothing_is_wrong(robots, seed, names):
    model = likelihood(robots["mgr"], sure=False, seed=seed, size=(0.5, 2.0, 5.0)[seed % 3], of_error=100 + seed)
    assert not beyond_uncertainty(model, found_with(model, names))


def test_that_something_ages_is_told_beside_an_uncertain_simulation(robots):
    """As much as a flexible regression might find of its errors, and yet no error of its own."""
    for moved, verdict in ((weakening, "unexplained"), (as_simulated, "no_gap")):
        model = likelihood(robots["mgr"], sure=False, moved=moved, size=2.0)
        search = CauseSearch(model, {"battery_sag": mechanism_class("battery_sag")}, None)
        assert explanation(model, search.run()).verdict == verdict
