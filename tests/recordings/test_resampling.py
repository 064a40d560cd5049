"""Resampling invents nothing: exact on what is linear or held, silent across gaps."""

import numpy as np
import pytest

from swarmtwin.recordings.resampling import interpolate_poses, mean_held


def test_interpolation_is_exact_for_a_steady_motion():
    time_s = np.sort(np.random.default_rng(1).uniform(0, 10, 2000))
    pose = np.stack([3 * time_s, 5 - 2 * time_s, 0.1 * time_s], axis=-1)
    at_s = np.linspace(0.5, 9.5, 19)
    expected = np.stack([3 * at_s, 5 - 2 * at_s, 0.1 * at_s], axis=-1)
    np.testing.assert_allclose(interpolate_poses(time_s, pose, at_s, longest_gap_s=0.1), expected, atol=1e-12)


def test_headings_are_interpolated_along_the_shorter_arc():
    pose = np.array([[0.0, 0.0, 3.0], [0.0, 0.0, -3.0]])
    middle = interpolate_poses(np.array([0.0, 1.0]), pose, np.array([0.25, 0.5, 0.75]), longest_gap_s=1.0)
    step = (2 * np.pi - 6) / 4
    np.testing.assert_allclose(middle[:, 2], [3 + step, np.pi, -3 - step])


def test_nothing_is_interpolated_across_a_gap_or_beyond_the_ends():
    time_s = np.array([1.0, 1.1, 1.3, 1.4])
    at_s = np.array([0.99, 1.0, 1.05, 1.1, 1.2, 1.3, 1.35, 1.4, 1.41])
    known = ~np.isnan(interpolate_poses(time_s, np.zeros((4, 3)), at_s, longest_gap_s=0.11)).any(axis=1)
    assert known.tolist() == [False, True, True, True, False, True, True, True, False]


def test_a_single_sample_gives_nothing():
    assert np.isnan(interpolate_poses(np.array([1.0]), np.zeros((1, 3)), np.array([1.0]), longest_gap_s=1.0)).all()


def test_means_are_weighted_by_the_time_a_command_is_held():
    time_s, values = np.array([-0.1, 0.1, 0.4, 0.6]), np.array([[10.0], [20.0], [0.0], [-5.0]])
    means = mean_held(time_s, values, np.array([0.0, 0.5, 1.0]), longest_hold_s=1.0)
    np.testing.assert_allclose(means[:, 0], [(0.1 * 10 + 0.3 * 20) / 0.5, (0.4 * -5) / 0.5])


def test_means_agree_with_a_fine_sum():
    generator = np.random.default_rng(2)
    time_s, values = np.sort(generator.uniform(0, 20, 500)), generator.normal(size=(500, 2))
    edges_s = np.arange(1.0, 19.0, 0.5)
    fine_s = np.arange(1.0, 18.5, 1e-5) + 5e-6
    fine = values[np.searchsorted(time_s, fine_s, side="right") - 1].reshape(len(edges_s) - 1, -1, 2).mean(axis=1)
    np.testing.assert_allclose(mean_held(time_s, values, edges_s, longest_hold_s=5.0), fine, atol=1e-3)


@pytest.mark.parametrize(
    ("longest_hold_s", "known"),
    [(2.0, [False, True, True, True]), (1.0, [False, True, False, False]), (0.9, [False, False, False, False])],
)
def test_an_interval_with_no_command_for_some_time_has_no_mean(longest_hold_s, known):
    time_s, edges_s = np.array([1.0, 2.0, 4.0]), np.array([0.0, 1.0, 3.0, 3.5, 5.0])
    means = mean_held(time_s, np.ones((3, 1)), edges_s, longest_hold_s)
    assert (~np.isnan(means[:, 0])).tolist() == known
    np.testing.assert_allclose(means[known], 1.0)
