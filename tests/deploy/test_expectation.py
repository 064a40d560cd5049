"""The watching simulation: its stated rate of false alarms holds, and what is wrong is heard within a few periods."""

import numpy as np
import pytest
import torch
from playground import NOISE, exact_simulation

from swarmtwin.deploy.control.expectation import Expectation, _e_value
from swarmtwin.deploy.control.settings import WatchSettings
from swarmtwin.geometry import exp_map, log_map
from tiny_policies import robot_named

PERIOD_S = 0.5
FAST = WatchSettings(periods_between_false_alarms=200.0)


@pytest.fixture(scope="module")
def simulation():
    return exact_simulation(robot_named("mgr"))


def watched(simulation, vehicles, periods, settings, seed, gain=1.0, from_period=0, spread=0.05, tails=None, lag=0.0):
    """Periods until each vehicle's first alarm (inf: none), and how many there were in all, restarting after each."""
    rng = np.random.default_rng(seed)
    watch = Expectation(simulation, [str(index) for index in range(vehicles)], settings)
    unit = 1 + spread * rng.standard_normal((vehicles, 3))
    first, alarms = np.full(vehicles, np.inf), 0
    before = np.zeros((vehicles, 2))
    for period in range(periods):
        command = rng.uniform(-120, 120, (vehicles, 2))
        twist = simulation.dynamics.twist(torch.as_tensor(command)).numpy()
        old = simulation.dynamics.twist(torch.as_tensor(before)).numpy()
        before = command
        wrong = period >= from_period
        true = twist * unit * (gain if wrong else 1.0) + (lag if wrong else 0.0) * (old - twist)
        size2 = (twist[:, :2] ** 2).sum(axis=1) / NOISE.usual_mm**2 + twist[:, 2] ** 2 / NOISE.usual_rad**2
        variance = np.array(NOISE.at_rest) + np.array(NOISE.with_motion) * size2[:, None]
        drawn = rng.standard_normal(true.shape)
        if tails:
            drawn = rng.standard_t(tails, true.shape)
        measured = exp_map(true + np.sqrt(variance) * drawn)
        begun = watch.update(exp_map(twist), measured, np.full(vehicles, PERIOD_S))
        for vehicle in begun:
            first[vehicle] = min(first[vehicle], period - from_period + 1)
        alarms += len(begun)
        watch.restart(begun)
    return first, alarms


def test_e_values_are_one_on_average_where_nothing_is_wrong():
    p = (np.arange(2_000_000) + 0.5) / 2_000_000
    assert 0.93 < _e_value(p).mean() <= 1.0  # the rest lies below the smallest p
    assert _e_value(np.array([1e-6]))[0] > 5000


@pytest.mark.parametrize("tails", [None, 6, 4])
def test_false_alarms_are_no_more_frequent_than_stated(simulation, tails):
    """Five seeds, units that differ as much as expected, noise as stated or with heavier tails."""
    vehicles, periods = 40, 250
    alarms = sum(watched(simulation, vehicles, periods, FAST, seed, tails=tails)[1] for seed in range(5))
    expected = 5 * vehicles * periods / FAST.periods_between_false_alarms
    assert alarms <= expected + 3 * np.sqrt(expected)


@pytest.mark.parametrize(
    ("wrong", "within"), [({"gain": 0.7}, 8), ({"gain": 0.5}, 3), ({"gain": 0.0}, 2), ({"lag": 0.3}, 6)]
)
def test_what_is_wrong_is_heard_within_a_few_periods(simulation, wrong, within):
    """At the shipped rate, one false alarm in 10,000 periods: the median over 60 vehicles."""
    first, _ = watched(simulation, 60, 40, WatchSettings(), 1, from_period=15, **wrong)
    assert np.median(first) <= within
    assert np.isfinite(first).mean() > 0.95


@pytest.mark.parametrize(("gain", "within"), [(0.7, 8), (1.4, 4), (0.5, 3)])
def test_what_is_wrong_from_the_beginning_is_heard_although_units_differ(simulation, gain, within):
    """The median over 60 vehicles: what speeds and turns say alike is pooled, or -30 % would take 10 periods here."""
    first, _ = watched(simulation, 60, 40, WatchSettings(), 2, gain=gain)
    assert np.median(first) <= within
    assert np.isfinite(first).mean() > 0.9


def test_units_are_taken_for_strange_from_the_beginning_no_more_often_than_stated(simulation):
    """The chance is that of a false alarm in `unit_alarm_periods`, once; units differ by as much as the prior says."""
    settings = WatchSettings(periods_between_false_alarms=1e4, unit_alarm_periods=500.0, unit_spread=0.07)
    vehicles, stated = 2000, 500.0 / 1e4
    first, _ = watched(simulation, vehicles, 30, settings, 5, spread=np.sqrt(2) * 0.07)
    by_others = 30 / 1e4
    share = stated + by_others
    assert np.isfinite(first).mean() <= share + 3 * np.sqrt(share / vehicles)


def test_a_unit_that_differs_as_units_do_is_not_told_but_one_that_changes_is(simulation):
    first, _ = watched(simulation, 40, 60, WatchSettings(), 4, spread=0.07)
    assert np.isfinite(first).mean() < 0.1


def test_a_vehicle_that_is_not_seen_changes_nothing(simulation):
    watch = Expectation(simulation, ["1", "2"], WatchSettings())
    measured = np.array([[10.0, 0, 0], [np.nan] * 3])
    watch.update(np.tile([10.0, 0, 0], (2, 1)), measured, np.full(2, PERIOD_S))
    assert watch.alarm[1] == 0
    assert np.isnan(watch.z[1]).all()
    assert watch.alarm[0] > 0


def test_a_vehicle_that_goes_the_wrong_way_for_long_is_severe(simulation):
    watch = Expectation(simulation, ["1"], WatchSettings(severe_periods=3))
    expected = exp_map(np.array([[30.0, 0.0, 0.1]]))
    begun = []
    for _ in range(3):
        assert not watch.is_severe[0]
        begun += watch.update(expected, exp_map(-log_map(expected)), np.array([PERIOD_S]))
    assert begun == [0]
    assert watch.is_severe[0]
    assert "vehicle 1 does not move as the simulation expects" in watch.words(0)
