"""The oracle: its filter's surprises are what chance makes of the truth, and it names what hides and nothing else."""

import math
from dataclasses import replace

import numpy as np
import pytest

from swarmtwin.standin.effects import parse_effects
from swarmtwin.standin.session import StandInSession
from swarmtwin.studies.hidden_effects.baselines.oracle import Oracle
from swarmtwin.studies.hidden_effects.baselines.oracle_causes import supposed_causes
from swarmtwin.studies.hidden_effects.baselines.oracle_filter import TrueLikelihood
from swarmtwin.studies.hidden_effects.cases import Case
from swarmtwin.studies.hidden_effects.effect_sizes import CATALOGUE
from swarmtwin.studies.hidden_effects.outside_effects import OUTSIDE_EFFECTS
from swarmtwin.studies.hidden_effects.sessions import reference_session, sized_entry
from swarmtwin.studies.stand_in_recording import record


def likelihood(robot, *entries, effects=(), runs=40, steps=12, seed=5, **options):
    effects = (*parse_effects(entries, robot, 1), *effects)
    session = StandInSession(robot, ("3",), runs, steps, seed, effects, lost_poses=0.01, **options)
    return TrueLikelihood.of(*record(session))


def oracle(model):
    """Return an oracle that tries fewer sets, for short recordings."""
    return Oracle(model, fitted_first=2, fitted_further=1, most_changed=2)


def surprises(model, effects):
    """Return whitened surprises (T, R, 3)."""
    evaluation = model.evaluate(effects, model.gains(model.linearise(effects)))
    steps, runs = model.driven.session.steps, model.driven.session.runs
    return evaluation.surprise.reshape(steps, runs, 3)


@pytest.mark.parametrize(
    ("name", "entry"),
    [
        ("mgr", {"name": "backlash", "travel_mm": 6.0}),
        ("mgr", {"name": "actuator_lag", "time_constant_s": 0.1}),
        ("mur", {"name": "steady_drift", "speed_mm_s": 10.0}),
        ("mur", {"name": "actuator_asymmetry", "angle_rad": 0.1}),
    ],
)
def test_surprises_are_independent_and_of_variance_one_under_the_truth_and_not_without_it(robots, name, entry):
    model = likelihood(robots[name], entry)
    under_truth = surprises(model, model.driven.session.effects)
    count = under_truth[..., 0].size
    assert (under_truth**2).mean(axis=(0, 1)) == pytest.approx(np.ones(3), abs=4.5 * math.sqrt(2 / count))
    assert under_truth.mean(axis=(0, 1)) == pytest.approx(np.zeros(3), abs=4.0 / math.sqrt(count))
    neighbours = (under_truth[1:] * under_truth[:-1]).mean(axis=(0, 1))
    assert neighbours == pytest.approx(np.zeros(3), abs=4.5 / math.sqrt(count))
    assert (surprises(model, ()) ** 2).mean() > 1.25 * (under_truth**2).mean()


def test_the_truth_is_likelier_than_what_is_beside_it(robots):
    model = likelihood(robots["mgr"], {"name": "gain_change", "gain": 0.9})
    gains = model.gains(model.linearise(model.driven.session.effects))

    def nats(gain):
        return model.evaluate(
            parse_effects([{"name": "gain_change", "gain": gain}], robots["mgr"], 1), gains
        ).nats.sum()

    tried = np.linspace(0.85, 0.95, 21)
    assert tried[np.argmax([nats(gain) for gain in tried])] == pytest.approx(0.9, abs=0.0101)
    assert nats(0.9) - nats(0.85) > 20


def test_fitted_values_miss_the_truth_by_as_much_as_the_likelihood_says(robots):
    """Over sessions, errors in standard errors are of size one and of no bias, though steps are many of these."""
    scores = []
    for seed in range(8):
        fits = oracle(likelihood(robots["mgr"], {"name": "gain_change", "gain": 0.95}, seed=seed)).fits
        fitted = fits.fit({"gain_change": np.array([0.9])})
        gains = fits.likelihood.gains(fitted.linear)

        def surprise(gain, fits=fits, gains=gains, robot=robots["mgr"]):
            effects = parse_effects([{"name": "gain_change", "gain": gain}], robot, 1)
            return fits.likelihood.evaluate(effects, gains).surprise

        gain = float(fitted.values["gain_change"][0])
        slope = (surprise(gain + 0.002) - surprise(gain - 0.002)) / 0.004
        scores.append((gain - 0.95) * math.sqrt(slope @ slope))
    assert abs(np.mean(scores)) < 3.5 / math.sqrt(8)
    assert 0.35 < np.sqrt(np.mean(np.square(scores))) < 2.0


@pytest.mark.parametrize(
    ("entry", "tolerance"),
    [
        ({"name": "gain_change", "gain": 0.9}, 0.012),
        ({"name": "dead_band", "width": 30.0}, 0.5),
        ({"name": "command_loss", "probability": 0.1}, 0.05),
    ],
)
def test_the_oracle_names_what_hides_and_nothing_else_and_finds_its_size(robots, entry, tolerance):
    named = oracle(likelihood(robots["mgr"], entry, runs=30, steps=10)).named()
    name, size = entry["name"], list(entry)[1]
    assert set(named) == {name}
    assert named[name][size] == pytest.approx(entry[size], abs=tolerance)


@pytest.mark.claims
def test_the_oracle_names_nothing_in_clean_sessions_regular_and_unruly(robots):
    assert oracle(likelihood(robots["mgr"], steps=10)).named() == {}
    unruly, twin = (likelihood(robots["mgr"], steps=10, seed=seed, character="unruly") for seed in (6, 7))
    assert oracle(unruly.with_tails_of(twin)).named() == {}


def test_an_unsteady_clock_is_told_by_its_spread(robots):
    model = likelihood(robots["mgr"], {"name": "timing_jitter", "spread": 0.05}, steps=20)
    assert Oracle(model)._jitter()["timing_jitter"]["spread"] == pytest.approx(0.05, rel=0.15)
    assert Oracle(likelihood(robots["mgr"]))._jitter() == {}


@pytest.mark.claims
def test_what_is_in_no_catalogue_gets_no_name_though_a_cause_comes_near_it(robots):
    case = Case(family="formulas", kind="outside", robot="mgr", names=["random_ground"], rises_percent=[1.0], seed=2)
    session = replace(reference_session(case, robots["mgr"]), runs=40, steps=12)
    entry = sized_entry("random_ground", 0.3, case, session)
    made = OUTSIDE_EFFECTS["random_ground"].parse({key: one for key, one in entry.items() if key != "name"}, "")
    model = likelihood(robots["mgr"], effects=(made,))
    assert oracle(model).named(model.driven.session.effects) == {}
    assert oracle(model).named() != {}


def test_the_oracle_supposes_every_cause_of_the_catalogue_at_all_sizes_that_are_hidden(robots):
    for name in ("mgr", "mur"):
        robot = robots[name]
        supposed = supposed_causes(robot, 2)
        assert {*supposed, "timing_jitter"} == set(CATALOGUE)
        for cause in supposed.values():
            case = Case(
                family="formulas", kind="one", robot=name, names=[cause.name], rises_percent=[1.0], seed=1, runs=20
            )
            session = replace(reference_session(case, robot), vehicles=("1", "2"))
            low, high = cause.named(cause.low), cause.named(cause.high)
            for size in CATALOGUE[cause.name][name]:
                entry = sized_entry(cause.name, size, case, session)
                for key in entry.keys() - {"name", "speed_mm_s", "direction_rad"}:
                    assert low[key] - 1e-9 <= entry[key] <= high[key] + 1e-9, (cause.name, key)
