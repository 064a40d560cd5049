"""What causes do is the same everywhere and at all times, or it was not these causes."""

import numpy as np
import pytest
import torch
from exact_base import ExactBase, Losing, known_noise, session_of

from swarmtwin.diagnosis.estimation import estimate
from swarmtwin.diagnosis.left_over import left_over
from swarmtwin.diagnosis.likelihood import SessionLikelihood
from swarmtwin.diagnosis.reference_errors import ReferenceErrors
from swarmtwin.diagnosis.varying_causes import nats_by_variation
from swarmtwin.geometry import exp_map
from swarmtwin.simulation.mechanism import mechanism_class

RUNS = 60

FACTORS = {
    "steady": lambda moment: torch.full((RUNS,), 0.95),
    "from a time on": lambda moment: torch.where(torch.arange(RUNS) < 24, 1.0, 0.92),
    "at a place": lambda moment: torch.where(moment.pose[:, 0] < 500.0, 1.0, 0.9),
    "in a direction": lambda moment: 0.95 + 0.05 * torch.cos(moment.pose[:, 2]),
    "of some commands": lambda moment: torch.where(moment.command[:, 0] < 0, 1.0, 0.9),
}


def fitted(robot, factor, cause, seed):
    """A session of vehicles that move by a factor, and what a cause of the catalogue makes of it."""
    base = ExactBase(robot)

    def moved(moment):
        return exp_map(moment.way * factor(moment)[:, None])

    session = session_of(base, np.random.default_rng(seed), moved=moved, runs=RUNS)
    model = SessionLikelihood(base, known_noise(), session)
    return model, estimate(model, [mechanism_class(cause[0]).at(cause[1])])


@pytest.mark.parametrize("seed", range(3))
@pytest.mark.parametrize("where", FACTORS)
def test_a_change_that_is_not_the_same_everywhere_is_seen(robots, where, seed):
    model, found = fitted(robots["mgr"], FACTORS[where], ("gain_change", {"gain": 0.95}), seed)
    assert found.fitted.total > model.evaluate([]).total + 20
    nats = nats_by_variation(model, found.fitted)
    assert nats < 2 if where == "steady" else nats > 8


@pytest.mark.parametrize("seed", range(3))
def test_a_loss_that_begins_at_once_is_no_battery_that_sags(robots, seed):
    """Of all that a regression on everything could find, it finds little; this one sees that the loss varies."""
    sag = ("battery_sag", {"loss": 0.1, "shape": 1.0})
    model, found = fitted(robots["mgr"], FACTORS["from a time on"], sag, seed)
    left = left_over(model, found, found.fitted.total - model.evaluate([]).total, ReferenceErrors())
    assert left.by_variation > max(left.by_situation, model.settings.verdict.nameless_nats)


def test_lost_commands_and_no_cause_do_not_vary(robots):
    base = ExactBase(robots["mgr"])
    session = session_of(base, np.random.default_rng(1), moved=Losing(0.1, 1), runs=RUNS)
    model = SessionLikelihood(base, known_noise(), session)
    lost = model.evaluate([mechanism_class("command_loss").at({"probability": 0.1})])
    assert nats_by_variation(model, lost) == nats_by_variation(model, model.evaluate([])) == 0.0
