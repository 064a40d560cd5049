"""What a session would have shown: an effect of the stated size is named nine times of ten, a third of it is not."""

import numpy as np
import pytest
from exact_base import ExactBase, as_simulated, known_noise, session_of
from scipy import stats

from swarmtwin.diagnosis.cause_search import CauseSearch
from swarmtwin.diagnosis.detection_limits import detection_limits
from swarmtwin.diagnosis.left_over import explanation
from swarmtwin.diagnosis.likelihood import SessionLikelihood
from swarmtwin.geometry import exp_map
from swarmtwin.simulation.mechanism import mechanism_class

SESSIONS = 8


def explained(base, moved, seed):
    session = session_of(base, np.random.default_rng(seed), moved, runs=40, steps=15)
    model = SessionLikelihood(base, known_noise(), session)
    return explanation(model, CauseSearch(model, {"gain_change": mechanism_class("gain_change")}).run())


def named(base, gain):
    """In how many sessions a gain is named."""
    return sum(
        "gain_change" in explained(base, lambda moment: exp_map(moment.way * gain), seed).names
        for seed in range(SESSIONS)
    )


@pytest.fixture(scope="module")
def base(robots):
    return ExactBase(robots["mgr"])


@pytest.fixture(scope="module")
def limits(base):
    return {limit.cause: limit for limit in detection_limits(explained(base, as_simulated, 100))}


@pytest.mark.claims
def test_an_effect_at_its_limit_is_named_nine_times_of_ten(base, limits):
    gain = limits["gain_change"].value
    assert 1.001 < gain < 1.05
    assert named(base, gain) >= stats.binom.ppf(0.01, SESSIONS, 0.9)
    assert named(base, 1 + (gain - 1) / 3) <= 1


def test_limits_are_told_for_what_was_not_found_alone(limits, base):
    assert {"gain_change", "command_delay", "marker_offset", "steady_drift"} <= set(limits)
    found = explained(base, lambda moment: exp_map(moment.way * 1.2), 101)
    assert "gain_change" not in {limit.cause for limit in detection_limits(found)}
