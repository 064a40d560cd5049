"""Dependence: nothing is found in noise, also where neighbours are correlated; what is planted is found by name."""

from dataclasses import replace

import numpy as np
import pytest
import torch
from exact_base import SPREAD, ExactBase, known_noise, session_of, steady_spread
from scipy import stats

from swarmtwin.diagnosis.dependence import StandardisedResidual, dependence_tests
from swarmtwin.diagnosis.discrepancy import Discrepancy
from swarmtwin.diagnosis.likelihood import SessionLikelihood
from swarmtwin.diagnosis.settings import DependenceSettings
from swarmtwin.geometry import exp_map

SEEDS = 40
MOST_FALSE = int(stats.binom.ppf(0.99, SEEDS, DependenceSettings().false_discovery_rate))
"""Sessions with anything found, where nothing is: its 99 % point at the level that the settings state."""
AR = 0.3
CONFOUNDED = {"position": {"time", "wall_distance"}}
"""What shows besides: a vehicle stays where it is for a run, and the middle is far from all walls."""


@pytest.fixture(scope="module")
def sessions(robots):
    """A measured session and the reference's, of the same robot."""
    base = ExactBase(robots["mgr"])
    return [session_of(base, np.random.default_rng(seed), runs=runs, steps=25) for seed, runs in ((1, 60), (2, 90))]


def white(session, rng):
    return rng.normal(size=(len(session), 3))


def lasting(session, rng):
    """Noise that lasts within a run: an autoregression with correlation 0.3 between neighbours."""
    noise = white(session, rng)
    for index in np.flatnonzero(session.follows >= 0):
        noise[index] = AR * noise[session.follows[index]] + np.sqrt(1 - AR**2) * noise[index]
    return noise


def examined(session, residual):
    usual = session.twist.std(dim=0)
    size = (session.twist / usual).numpy()
    return StandardisedResidual(session, residual, residual, size, (), np.ones(len(residual)))


def found(tests):
    return {test.part for test in tests if test.found}


@pytest.mark.parametrize("noise", [white, lasting])
def test_nothing_is_found_in_noise(sessions, noise):
    false = {}
    for seed in range(SEEDS):
        rng = np.random.default_rng(seed)
        here, there = (examined(session, noise(session, rng)) for session in sessions)
        if parts := found(dependence_tests(here, there, seed)):
            false[seed] = parts
    assert len(false) <= MOST_FALSE, false


def test_levels_are_honest(sessions):
    """P-values of what is not there are below a level as often as it says, within the binomial distribution's 99 %."""
    p_values = []
    for seed in range(20):
        rng = np.random.default_rng(700 + seed)
        here, there = (examined(session, white(session, rng)) for session in sessions)
        p_values += [test.p_value for test in dependence_tests(here, there, seed)]
    for level in (0.05, 0.5):
        fewest, most = stats.binom.ppf([0.005, 0.995], len(p_values), level)
        assert fewest <= np.sum(np.array(p_values) < level) <= most, level


def planted(session):
    situation = session.situation
    heading, elapsed_s = situation.pose[:, 2].numpy(), situation.elapsed_s.numpy()
    command, previous = (getattr(situation, name).numpy() / 120 for name in ("command", "previous_command"))
    x_mm, y_mm = situation.pose[:, 0].numpy(), situation.pose[:, 1].numpy()
    inside = np.hypot(x_mm - 515, y_mm - 515) < 150
    late = elapsed_s / elapsed_s.max()
    return {
        "heading": 0.4 * np.cos(2 * heading),
        "command": 1.2 * command[:, 0] * command[:, 1],
        "previous_command": 0.4 * previous[:, 1],
        "position": 1.0 * (inside - inside.mean()),
        "time": 1.6 * (late - 0.5),
    }


@pytest.mark.parametrize("part", ["heading", "command", "previous_command", "position", "time"])
@pytest.mark.parametrize("axis", [0, 2])
def test_what_is_planted_is_found_by_name(sessions, part, axis):
    rng = np.random.default_rng(3)
    residual = white(sessions[0], rng)
    residual[:, axis] += planted(sessions[0])[part]
    tests = dependence_tests(examined(sessions[0], residual), examined(sessions[1], white(sessions[1], rng)), 5)
    assert part in found(tests)
    assert found(tests) <= {part, "spread", "tails", *CONFOUNDED.get(part, ())}


@pytest.mark.parametrize("part", ["heading", "command", "previous_command"])
def test_what_the_reference_shows_as_well_is_no_news(sessions, part):
    rng = np.random.default_rng(4)
    residuals = [white(session, rng) for session in sessions]
    for session, residual in zip(sessions, residuals, strict=True):
        residual[:, 0] += planted(session)[part]
    here, there = (examined(*pair) for pair in zip(sessions, residuals, strict=True))
    assert not found(dependence_tests(here, there, 6))
    alone = examined(sessions[1], white(sessions[1], rng))
    assert part in found(dependence_tests(here, alone, 6))


def test_what_is_uncertain_in_the_simulation_is_not_found(sessions):
    rng = np.random.default_rng(8)
    shape = planted(sessions[0])["heading"]
    residual = white(sessions[0], rng)
    residual[:, 0] += shape
    there = examined(sessions[1], white(sessions[1], rng))
    here = examined(sessions[0], residual)
    assert "heading" in found(dependence_tests(here, there, 7))
    effects = np.zeros((*residual.shape, 1))
    effects[:, 0, 0] = shape
    assert "heading" not in found(dependence_tests(replace(here, effects=(effects.reshape(-1, 1),)), there, 7))


def test_what_is_uncertain_of_all_axes_together_is_found_no_more_often_than_by_chance(sessions):
    """One size, drawn anew for each session, of a function of the heading ahead, to the left and turning."""
    p_values, there = [], examined(sessions[1], white(sessions[1], np.random.default_rng(17)))
    effects = np.repeat(planted(sessions[0])["heading"], 3)[:, None]
    for seed in range(SEEDS):
        rng = np.random.default_rng(800 + seed)
        residual = white(sessions[0], rng) + rng.normal() * effects.reshape(-1, 3)
        here = replace(examined(sessions[0], residual), effects=(effects,))
        p_values += [test.p_value for test in dependence_tests(here, there, seed) if test.part == "heading"]
    assert np.sum(np.array(p_values) < 0.05) <= stats.binom.ppf(0.99, SEEDS, 0.05)


def test_runs_that_differ_show_as_time(sessions):
    rng = np.random.default_rng(9)
    session = sessions[0]
    residual = white(session, rng)
    residual[:, 0] += rng.normal(0, 0.4, session.runs)[session.run]
    here, there = examined(session, residual), examined(sessions[1], white(sessions[1], rng))
    assert found(dependence_tests(here, there, 8)) == {"time"}


@pytest.mark.parametrize(("factor", "explained"), [(1.25, 0.5), (0.8, -0.35)])
def test_another_spread_is_found_as_spread(sessions, factor, explained):
    rng = np.random.default_rng(10)
    here, there = (examined(session, white(session, rng)) for session in sessions)
    tests = dependence_tests(replace(here, by_usual_noise=here.residual * factor), there, 9)
    spread = next(test for test in tests if test.part == "spread")
    assert "spread" in found(tests)
    assert spread.explained == pytest.approx(explained, abs=0.1)
    assert not found(tests) - {"spread", "tails"}


def test_the_same_seed_gives_the_same_tests(sessions):
    rng = np.random.default_rng(11)
    here, there = (examined(session, lasting(session, rng)) for session in sessions)
    assert dependence_tests(here, there, 12) == dependence_tests(here, there, 12)


@pytest.fixture(scope="module")
def reference_residual(robots):
    """What a reference of an exact simulation shows, and what its simulation may get wrong."""
    base = ExactBase(robots["mgr"])
    session = session_of(base, np.random.default_rng(1), runs=120, steps=30)
    discrepancy = Discrepancy.learn(SessionLikelihood(base, known_noise(), session), 0.3)
    model = SessionLikelihood(base, known_noise(), session, discrepancy=discrepancy)
    return base, discrepancy, StandardisedResidual.of(model, model.evaluate([]))


@pytest.mark.parametrize(("gain", "noise", "part"), [(1.0, 1.0, None), (1.0, 1.5, "spread"), (1.05, 1.0, "command")])
def test_noise_shows_as_spread_and_a_gain_by_the_command_alone(reference_residual, gain, noise, part):
    """The variance that goes with it is what motion and noise make it, less what clipping and chance take off."""
    base, discrepancy, reference = reference_residual
    session = session_of(
        base,
        np.random.default_rng(3),
        moved=lambda moment: exp_map(gain * moment.way),
        spread=lambda way: noise * steady_spread(way),
        runs=75,
    )
    model = SessionLikelihood(base, known_noise(), session, discrepancy=discrepancy)
    measured = StandardisedResidual.of(model, model.evaluate([]))
    tests = dependence_tests(measured, reference, 0)
    assert found(tests) - ({"tails"} if noise > 1 else set()) == ({part} if part else set())
    systematic = float(((((gain - 1) * session.twist.numpy()) / SPREAD) ** 2).mean())
    true = {"command": systematic / (systematic + 1), "spread": noise**2 - 1}
    if part:
        assert next(test.explained for test in tests if test.part == part) == pytest.approx(true[part], rel=0.15)


def test_what_is_wrong_in_all_runs_alike_is_no_matter_of_time(sessions):
    rng = np.random.default_rng(14)
    session = sessions[0]
    there = examined(sessions[1], white(sessions[1], rng))
    here = examined(session, white(session, rng))
    lasting_error = here.residual + 0.4 * np.array([1.0, 0.0, 0.0]) + 0.4 * here.size
    assert "time" not in found(dependence_tests(replace(here, residual=lasting_error), there, 10))


def of_two(session, ids):
    """The session in which every second run is another vehicle's."""
    transitions = session.transitions
    return replace(session, transitions=replace(transitions, vehicle=transitions.run % 2, vehicles=ids))


@pytest.mark.parametrize(
    ("ids", "here", "there", "is_news"),
    [
        (("1", "2"), 0.0, 0.4, False),
        (("1", "2"), 0.4, 0.4, True),
        (("7", "8"), 0.4, 0.4, False),
        (("7", "8"), 0.4, 0.0, True),
    ],
)
def test_vehicles_are_compared_with_themselves(sessions, ids, here, there, is_news):
    """The reference's are 7 and 8; those by other ids are compared with each other alone."""
    rng = np.random.default_rng(15)
    residuals = []
    for session, names, difference in ((sessions[0], ids, here), (sessions[1], ("7", "8"), there)):
        both = of_two(session, names)
        errors = white(both, rng) + difference * np.outer(both.transitions.vehicle - 0.5, [1.0, 0.0, 0.0])
        residuals.append(examined(both, errors))
    assert ("vehicle" in found(dependence_tests(*residuals, 11))) is is_news


def test_what_a_vehicle_of_a_group_does_in_a_run_shows_as_time_and_what_it_does_in_all_of_them_does_not(sessions):
    """Rows lie run by run, and there vehicle by vehicle, each of which is compared with itself."""
    rng = np.random.default_rng(16)
    there = examined(sessions[1], white(sessions[1], rng))
    session = sessions[0]
    second = (np.arange(len(session)) % 25 >= 13).astype(int)
    both = replace(session, transitions=replace(session.transitions, vehicle=second, vehicles=("1", "2")))
    for of_a_run, is_found in ((0.7, True), (0.0, False)):
        errors = white(both, rng)
        errors[:, 0] += rng.normal(0, of_a_run, (session.runs, 2))[session.run, second] + 0.5 * second
        assert ("time" in found(dependence_tests(examined(both, errors), there, 12))) is is_found


def test_units_that_differ_show_neither_as_time_nor_as_noise(reference_residual):
    """Two vehicles that the reference does not know take turns, of which one goes 3 % farther, the other less far."""
    base, discrepancy, reference = reference_residual

    def of_their_own(moment):
        return exp_map(moment.way * torch.where(torch.arange(len(moment.way)) % 2 == 0, 1.03, 0.97)[:, None])

    session = of_two(session_of(base, np.random.default_rng(5), moved=of_their_own), ("8", "9"))
    model = SessionLikelihood(base, known_noise(), session, known_vehicles=("1",), discrepancy=discrepancy)
    tests = dependence_tests(StandardisedResidual.of(model, model.evaluate([])), reference, 0)
    assert not found(tests) & {"time", "spread", "tails"}
