"""Stamps of another clock on this machine's clock: delays are seen, steps of the clock are forgiven."""

import numpy as np
import pytest

from swarmtwin.deploy.camera.stamp_clock import StampClock

PERIOD_S = 1 / 30


def ages_s(delays_s, clock_s, clock=None):
    """Ages at arrival of pictures taken every period, each delayed, stamped by a clock that is ahead by `clock_s`."""
    clock = clock or StampClock()
    taken_s = 100.0 + np.arange(len(delays_s)) * PERIOD_S
    arrived_s = np.maximum.accumulate(taken_s + delays_s)
    return [
        arrived - clock.captured_s(taken + ahead, arrived)
        for taken, arrived, ahead in zip(taken_s, arrived_s, np.broadcast_to(clock_s, len(delays_s)), strict=True)
    ]


def test_delays_are_in_the_age_but_for_the_smallest():
    delays_s = np.random.default_rng(1).uniform(0.004, 0.030, 3000)
    delays_s[10] = 0.004
    ages = ages_s(delays_s, clock_s=1.7e9)
    np.testing.assert_allclose(ages[11:], (delays_s - 0.004)[11:], atol=0.003)


def test_a_delay_that_begins_and_stays_is_believed():
    delays_s = np.where(np.arange(1000) < 200, 0.005, 0.505)
    ages = np.array(ages_s(delays_s, clock_s=-50.0))
    assert ages[:200] == pytest.approx(0, abs=1e-6)
    assert (ages[220:] > 0.48).all()


@pytest.mark.parametrize("step_s", [-3600.0, -1.0, -0.05, 0.02, 0.5, 3600.0, 1e9])
def test_a_step_of_the_camera_s_clock_is_learned_at_once(step_s):
    delays_s = np.full(400, 0.005)
    clock_s = np.where(np.arange(400) < 200, 0.0, step_s)
    assert np.abs(ages_s(delays_s, clock_s)).max() < 1e-6


def test_a_step_that_no_stamp_shows_makes_pictures_look_too_old_not_too_young():
    ages = np.array(ages_s(np.full(400, 0.005), np.where(np.arange(400) < 200, 0.0, -0.02)))
    assert ages.min() >= 0
    assert ages[200:] == pytest.approx(0.02, abs=0.004)


def test_a_step_back_while_no_picture_came_is_recognised_when_no_picture_can_be_that_old():
    clock = StampClock()
    clock.captured_s(1000.0, 0.0)
    assert clock.captured_s(1001.0, 60.0) == 60.0
    assert clock.captured_s(1002.0, 61.5) == pytest.approx(61.0, abs=1e-3)


@pytest.mark.parametrize("drift", [-2e-4, 2e-4])
def test_clocks_that_run_unlike_are_followed(drift):
    count = 30 * 600
    ages = ages_s(np.full(count, 0.005), np.arange(count) * PERIOD_S * drift)
    assert np.abs(ages).max() < 1e-6


def test_no_picture_is_younger_than_its_arrival_whatever_the_stamps():
    rng = np.random.default_rng(2)
    for _ in range(20):
        stamps = rng.normal(0, 10.0 ** rng.uniform(-3, 9), 300)
        ages = ages_s(rng.exponential(0.02, 300), stamps)
        assert min(ages) >= 0
