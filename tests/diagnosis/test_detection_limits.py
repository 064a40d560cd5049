"""What a session would have shown: an effect over its limit is named, by its own name, and one of half of it rarely."""

import numpy as np
import pytest
import torch
from exact_base import SPREAD, ExactBase, as_simulated, known_noise, session_of
from scipy import stats

from swarmtwin.diagnosis.cause_search import CauseSearch
from swarmtwin.diagnosis.detection_limits import detection_limits
from swarmtwin.diagnosis.explanation import explanation
from swarmtwin.diagnosis.gains import Errors, confirmed_from, gains
from swarmtwin.diagnosis.likelihood import SessionLikelihood
from swarmtwin.diagnosis.motion_noise_change import noise_change_probability, usual_noise_spread
from swarmtwin.diagnosis.settings import DiagnosisSettings
from swarmtwin.geometry import compose, exp_map
from swarmtwin.simulation.mechanism import mechanism_class

SESSIONS = 6
OFFERED = {name: mechanism_class(name) for name in ("gain_change", "command_delay", "actuator_lag", "command_loss")}


def only(*names):
    return {name: OFFERED[name] for name in names}


def session_likelihood(base, moved, seed, spread=1.0):
    """A short session in which something happens, or noise is wider than it was."""
    noise = torch.tensor(SPREAD, dtype=torch.float64) * spread
    session = session_of(
        base, np.random.default_rng(seed), moved, spread=lambda way: noise.expand_as(way), runs=20, steps=15
    )
    return SessionLikelihood(base, known_noise(), session)


def explained(base, moved, seed, offered=OFFERED):
    model = session_likelihood(base, moved, seed)
    return explanation(model, CauseSearch(model, offered).run())


def weaker(gain):
    return lambda moment: exp_map(moment.way * gain)


def late(delay_s):
    def moved(moment):
        share = delay_s / moment.base.robot.period_s
        return compose(exp_map(moment.way_before * share), exp_map(moment.way * (1 - share)))

    return moved


def losing(share):
    """Commands are lost at random; which ones, nobody tells the diagnosis."""
    rng = np.random.default_rng(round(1e6 * share))

    def moved(moment):
        gone = torch.as_tensor(rng.random(len(moment.way)) < share)[:, None]
        return exp_map(torch.where(gone, moment.way_before, moment.way))

    return moved


def sure(base, name, moved, offered):
    """In how many sessions a cause that is there is sure to be."""
    found = (CauseSearch(session_likelihood(base, moved, seed), offered).run() for seed in range(SESSIONS))
    return sum(one.probability(name) >= 0.9 for one in found)


@pytest.fixture(scope="module")
def base(robots):
    return ExactBase(robots["mgr"])


@pytest.fixture(scope="module")
def clean(base):
    return explained(base, as_simulated, 100)


@pytest.fixture(scope="module")
def limits(clean):
    return {one.limit.cause: one.limit for one in detection_limits(clean, kinds=OFFERED)}


@pytest.mark.parametrize(
    ("name", "nothing", "planted", "offered"),
    [
        ("gain_change", 1.0, weaker, only("gain_change", "command_delay")),
        ("command_delay", 0.0, late, only("command_delay", "actuator_lag")),
    ],
)
def test_an_effect_over_its_limit_is_named_and_one_of_half_of_it_rarely(base, limits, name, nothing, planted, offered):
    """At the limit nine of ten are claimed, at 1.3 times the limit more than that."""
    size = limits[name].value - nothing
    assert sure(base, name, planted(nothing + 1.3 * size), offered) >= stats.binom.ppf(0.01, SESSIONS, 0.9)
    assert sure(base, name, planted(nothing + 0.5 * size), offered) <= 1


def test_a_small_delay_may_be_taken_for_a_lag_and_its_limit_says_so(limits, clean):
    assert limits["command_delay"].rival == "actuator_lag"
    alone = {"command_delay": OFFERED["command_delay"]}
    (unrivalled,) = (one.limit for one in detection_limits(clean, kinds=alone))
    assert unrivalled.rival is None
    assert unrivalled.value < limits["command_delay"].value / 2


def test_the_limit_of_lost_commands_is_where_enough_are_lost(base, limits):
    """One of them may already be seen, so that a tenth of the limit is named now and then."""
    lost, offered = limits["command_loss"].value, only("command_loss")
    assert sure(base, "command_loss", losing(1.3 * lost), offered) >= stats.binom.ppf(0.01, SESSIONS, 0.9)
    assert sure(base, "command_loss", losing(0.1 * lost), offered) <= SESSIONS / 2


def test_the_limit_of_noise_is_where_more_of_it_is_named(base, clean):
    kinds = {"noise_change": mechanism_class("noise_change")}
    (limit,) = (one.limit for one in detection_limits(clean, kinds=kinds))

    def named(factor):
        models = (session_likelihood(base, as_simulated, seed, factor) for seed in range(SESSIONS))
        chances = [
            noise_change_probability(*one.motion_noise_log(), usual_noise_spread(one, ()), one.settings)
            for one in models
        ]
        return sum(chance >= 0.9 for chance in chances)

    assert named(1 + 1.3 * (limit.value - 1)) >= stats.binom.ppf(0.01, SESSIONS, 0.9)
    assert named(1 + 0.5 * (limit.value - 1)) <= 2


def test_what_was_found_has_a_limit_of_its_own_which_is_that_of_a_session_without_it(base, clean):
    """Held-out runs confirm it as well: what they err by is what all that was found leaves, the cause included."""

    def limit(found, moved):
        unfitted = session_likelihood(base, moved, 102)
        limits = detection_limits(found, unfitted, only("gain_change"))
        return {one.limit.cause: one.limit.value for one in limits}["gain_change"]

    there = limit(explained(base, weaker(1.2), 101, only("gain_change")), weaker(1.2))
    assert 1.005 < there < 1.05
    assert there - 1 == pytest.approx(limit(clean, as_simulated) - 1, rel=0.3)


def test_a_limit_needs_errors_that_fall_measurably_on_held_out_runs():
    """How often an effect of the stated size has a gain whose interval is above zero, counted."""
    rng = np.random.default_rng(3)
    run = np.repeat(np.arange(30), 20)
    noise = np.array([1.0, 1.0, 0.03])
    change = np.column_stack([rng.normal(size=600), np.zeros(600), np.zeros(600)])
    factor = confirmed_from(noise * rng.normal(size=(600, 3)), change, run)

    def confirmed(size):
        error = noise * rng.normal(size=(600, 3))
        before, after = (
            Errors(np.column_stack([np.hypot(one[:, 0], one[:, 1]), np.abs(one[:, 2])]), (), (), (), ())
            for one in (error + size * change, error)
        )
        return gains(before, after, run, 400, rng).position_mm.low > 0

    counts = {share: sum(confirmed(share * factor) for _ in range(60)) for share in (0.5, 1.0, 1.3)}
    assert counts[1.0] >= stats.binom.ppf(0.005, 60, 0.85)
    assert counts[1.3] >= 57
    assert counts[0.5] <= 30


def test_limits_looked_for_in_a_part_are_those_of_the_whole_session(base):
    """Where a cause shows best, and its rivals, a part of the runs tells; how large it must be, all of them.

    A patch shows best elsewhere in each, and is another one.
    """
    session = session_of(base, np.random.default_rng(7), as_simulated, runs=80, steps=15)
    whole, in_part = (
        SessionLikelihood(base, known_noise(), session, settings=DiagnosisSettings.parse({"search": most}, "here"))
        for most in ({}, {"most_screened": 400})
    )
    assert len(in_part.thinned(400).session) < 0.5 * len(whole.thinned(1500).session)
    limits = [
        {one.limit.cause: one.limit for one in detection_limits(explanation(model, CauseSearch(model, OFFERED).run()))}
        for model in (whole, in_part)
    ]
    assert limits[0].keys() == limits[1].keys()
    for name, limit in limits[0].items():
        assert (limit.value is None) == (limits[1][name].value is None)
        assert name == "surface_patch" or limits[1][name].share_of_range == pytest.approx(limit.share_of_range, rel=0.1)
