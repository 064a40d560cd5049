"""Noise whose size is known is found beneath a function that is not."""

import numpy as np
import pytest

from swarmtwin.learning.noise_variance import noise_variance

SPREAD = np.array([1.0, 0.3])


def drawn(seed, count=2000, columns=3, runs=40, rough=1.0):
    """Inputs, a function of them plus noise, and the run of each row."""
    rng = np.random.default_rng(seed)
    inputs = rng.uniform(-1, 1, (count, columns))
    waves = np.random.default_rng(99).normal(0, rough, (columns, 2))
    function = 5 * np.sin(inputs @ waves) * SPREAD
    return inputs, function + rng.normal(size=(count, 2)) * SPREAD, np.arange(count) * runs // count


def estimate(inputs, outputs, run, **more):
    return noise_variance(inputs, outputs, np.zeros(len(run), int), run % 5, run, **more)


def test_the_noise_is_found_and_its_interval_is_honest():
    inside = 0
    for seed in range(40):
        found = estimate(*drawn(seed))
        low, high = np.quantile(found.drawn(400), [0.025, 0.975], axis=0)
        inside += ((low <= SPREAD**2) & (high >= SPREAD**2)).sum()
        np.testing.assert_allclose(found.value, SPREAD**2, rtol=0.25)
    assert 68 <= inside <= 80  # of 80, 95 % of them expected: 68 or fewer once in a thousand times


def test_what_lasts_in_a_run_counts_as_noise():
    inputs, outputs, run = drawn(3)
    lasting = np.random.default_rng(1).normal(0, 2.0, run.max() + 1)[run]
    found = estimate(inputs, outputs + lasting[:, None], run)
    assert found.value[0] == pytest.approx(1.0 + 4.0, rel=0.4)


def test_what_differs_between_groups_does_not():
    inputs, outputs, run = drawn(3)
    group = run % 2
    found = noise_variance(inputs, outputs + 7.0 * group[:, None], group, run % 5, run)
    np.testing.assert_allclose(found.value, SPREAD**2, rtol=0.25)


def test_with_few_points_in_many_dimensions_it_is_too_high_for_outputs_and_not_for_what_a_good_model_leaves():
    inputs, outputs, run = drawn(5, count=400, columns=9, rough=1.5)
    exact = 5 * np.sin(inputs @ np.random.default_rng(99).normal(0, 1.5, (9, 2))) * SPREAD
    assert (estimate(inputs, outputs, run).value > 2 * SPREAD**2).all()
    np.testing.assert_allclose(estimate(inputs, outputs - exact, run).value, SPREAD**2, rtol=0.3)


def test_too_few_points_give_none():
    inputs, outputs, run = drawn(1, count=9, runs=3)
    assert estimate(inputs, outputs, run) is None
    assert estimate(inputs, outputs, run, neighbours=3) is not None


def test_inputs_that_are_all_the_same_leave_the_variance():
    _, outputs, run = drawn(2)
    noise = outputs - outputs
    noise += np.random.default_rng(4).normal(size=noise.shape)
    found = estimate(np.zeros((len(run), 2)), noise, run)
    np.testing.assert_allclose(found.value, 1.0, rtol=0.1)
