"""What is left over alarms where the simulation is sure of itself, and not where it was learned from too little."""

import numpy as np
import pytest
import torch
from exact_base import ExactBase, as_simulated, errors_showing, known_noise, session_of

from swarmtwin.diagnosis.cause_search import CauseSearch
from swarmtwin.diagnosis.estimation import estimate
from swarmtwin.diagnosis.explanation import explanation
from swarmtwin.diagnosis.gain_by_chance import nats_by_chance
from swarmtwin.diagnosis.left_over import left_over, nats_of_uncertainty
from swarmtwin.diagnosis.likelihood import SessionLikelihood
from swarmtwin.diagnosis.noise import log_density
from swarmtwin.diagnosis.reference_errors import ReferenceErrors
from swarmtwin.diagnosis.screening import sought_kinds
from swarmtwin.dynamics.predictor import DynamicsModule
from swarmtwin.geometry import exp_map

FOLDS = 6


class LearnedBase(DynamicsModule):
    """The exact model with a smooth error of the commands, as of one that was learned from few transitions.

    Its members have seen different runs. They err by the same, and each a little otherwise: so that a jackknife over
    them is as large as the error where `sure` is False, and a tenth of it where it is True.
    """

    inputs = ("command",)
    members = FOLDS

    def __init__(self, robot, sure, size=0.35, waves=12):
        super().__init__()
        self.robot, self.exact = robot, ExactBase(robot)
        rng, columns = np.random.default_rng(11), len(robot.command)
        self.waves = torch.as_tensor(rng.normal(0, 2.0, (FOLDS + 1, columns, waves)))
        self.offsets = torch.as_tensor(rng.uniform(0, 2 * np.pi, (FOLDS + 1, waves)))
        self.shares = torch.as_tensor(rng.normal(0, size * np.sqrt(2 / waves), (FOLDS + 1, waves, 3)))
        self.shares *= torch.tensor([1.0, 1.0, 0.02])
        self.shares[1:] *= np.sqrt(FOLDS) / (FOLDS - 1) * (0.1 if sure else 1.0)

    def _function(self, command, number):
        low, high = torch.as_tensor(self.robot.command_low), torch.as_tensor(self.robot.command_high)
        unit = 2 * (command - low) / (high - low) - 1
        return torch.cos(unit @ self.waves[number] + self.offsets[number]) @ self.shares[number]

    def twist(self, situation, member=None):
        command = situation.command.double()
        members = range(FOLDS) if member is None else [member]
        own = torch.stack([self._function(command, 1 + one) for one in members]).mean(dim=0)
        return self.exact.twist(command) + self._function(command, 0) + own

    def predict(self, situation):
        return exp_map(self.twist(situation))


def likelihood(robot, sure, moved=as_simulated, seed=3, size=0.35):
    session = session_of(ExactBase(robot), np.random.default_rng(seed), moved)
    return SessionLikelihood(LearnedBase(robot, sure, size), known_noise(), session)


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
