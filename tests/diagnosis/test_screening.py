"""Where the search for a cause begins: nowhere worse than where it was looked at."""

import numpy as np
import pytest
import torch
from exact_base import ExactBase, known_noise, session_of

from swarmtwin.diagnosis.likelihood import SessionLikelihood
from swarmtwin.diagnosis.screening import candidates
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
    best = max(found, key=lambda one: one.nats)
    assert model.evaluate(best.start).total > max(on_grid) - 1.0
    assert abs(best.start[0].width - 22.3) < 2.0
