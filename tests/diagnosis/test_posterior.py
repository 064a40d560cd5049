"""The posterior over sets of causes: forms of the same causes are summed up, evidence is told without prior odds."""

from types import SimpleNamespace

import numpy as np
import pytest

from exact_model import conditions_of
from swarmtwin.diagnosis.cause_report import leading_sets
from swarmtwin.diagnosis.cause_search import CausePosterior, share_beside
from swarmtwin.diagnosis.explanation import Explanation
from swarmtwin.diagnosis.left_over import LeftOver
from swarmtwin.diagnosis.settings import DiagnosisSettings, SearchSettings
from swarmtwin.simulation.mechanism import mechanism_class

ODDS_AGAINST = 3.0


def posterior_of(**evidence):
    """A posterior over sets with names joined by _and_, each with its evidence over nothing, mean over its forms."""
    rows = [((), 0.0, 1)]
    for key, (nats, forms) in evidence.items():
        rows.append((tuple(key.split("_and_")), nats, forms))
    sets, logs = [], []
    for names, nats, forms in rows:
        for _ in range(forms):  # each form has as much evidence, and its share of the prior
            sets.append(SimpleNamespace(names=names))
            logs.append(nats - len(names) * ODDS_AGAINST - np.log(forms))
    order = np.argsort(logs)[::-1]
    logs = np.array(logs)[order]
    sets = [sets[index] for index in order]
    nothing = next(one for one in sets if not one.names)
    odds = np.array([len(one.names) * ODDS_AGAINST for one in sets])
    return CausePosterior(tuple(sets), logs - np.logaddexp.reduce(logs), nothing, odds)


def test_forms_of_the_same_causes_are_one_set_and_evidence_is_over_nothing():
    posterior = posterior_of(gain_change=(5.0, 2), command_delay=(4.0, 1), gain_change_and_marker_yaw=(6.0, 4))
    sets = leading_sets(posterior, 8)
    weights = {
        ("gain_change",): np.exp(5.0 - 3),
        ("command_delay",): np.exp(4.0 - 3),
        ("gain_change", "marker_yaw"): np.exp(6.0 - 6),
        (): 1.0,
    }
    assert {one.causes for one in sets} == weights.keys()
    assert [one.probability for one in sets] == sorted((one.probability for one in sets), reverse=True)
    for one in sets:
        assert one.probability == pytest.approx(weights[one.causes] / sum(weights.values()), rel=1e-4)
    assert {one.causes: one.log_evidence for one in sets} == pytest.approx(
        {("gain_change",): 5.0, ("command_delay",): 4.0, ("gain_change", "marker_yaw"): 6.0, (): 0.0}, abs=1e-4
    )


def test_at_most_so_many_sets_are_kept_and_nothing_is_always_one_of_them():
    posterior = posterior_of(**{f"cause{number}": (20.0 + number, 1) for number in range(12)})
    sets = leading_sets(posterior, 8)
    assert [one.causes for one in sets] == [(f"cause{number}",) for number in (11, 10, 9, 8, 7, 6, 5)] + [()]


@pytest.mark.parametrize(
    ("robot", "causes", "share"),
    [
        ("mur", ("gain_change",), 0.0),
        ("mur", ("gain_change", "actuator_lag"), 0.02),
        ("mur", ("backlash", "actuator_lag"), 0.08),
        ("mur", ("backlash", "gain_change", "command_delay"), 0.02 + 0.08),
        ("mur", ("timing_jitter", "actuator_lag", "command_delay"), 0.08),
        ("mgr", ("backlash", "actuator_lag"), 0.02),
    ],
)
def test_of_thrust_causes_that_say_when_it_follows_tell_less_of_each_other(robots, robot, causes, share):
    model = SimpleNamespace(robot=robots[robot], read_off_clock=lambda kind: kind is mechanism_class("timing_jitter"))
    kinds = [mechanism_class(name) for name in causes]
    assert share_beside(SearchSettings(), model, kinds) == pytest.approx(share)


@pytest.mark.parametrize(
    ("cause", "parameter", "value", "error", "named"),
    [
        ("battery_sag", "loss", 0.93, 0.005, True),  # far from the end of its range, 0.95, by its own measure
        ("battery_sag", "loss", 0.93, 0.02, False),  # it may as well be the end, and more
        ("battery_sag", "loss", 0.60, 0.25, True),  # hardly known, but in the middle
        ("battery_sag", "loss", 0.95, 0.001, False),
        ("gain_change", "gain", 0.95, 0.02, True),
        ("gain_change", "gain", 0.95, 0.04, False),  # it may as well be 1
    ],
)
def test_a_cause_that_may_lie_at_an_end_or_do_nothing_is_not_named(robots, cause, parameter, value, error, named):
    kind, robot = mechanism_class(cause), robots["mgr"]
    parameters = [(0, parameter, kind.parameters_of(robot, conditions_of(robot))[parameter])]
    model = SimpleNamespace(
        settings=DiagnosisSettings(), parameters=lambda kinds: parameters, session=range(4000), strange=()
    )
    covariance = np.array([[error**2]])
    best = SimpleNamespace(mechanisms=[kind], names=(cause,), values=np.array([value]), covariance=covariance)
    noise = SimpleNamespace(probability=0.0)
    explained = Explanation(model, posterior_of(**{cause: (300.0, 1)}), best, 300.0, LeftOver(0.0, 0.0), noise)
    assert explained.names == ((cause,) if named else ())
    if cause == "gain_change":
        assert explained.verdict == ("explained" if named else "no_gap")
