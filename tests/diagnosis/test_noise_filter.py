"""The compiled filter says what the joint covariance of a run's errors says, written down as one matrix."""

import numpy as np
import pytest

from swarmtwin.diagnosis.noise import inverse_adjoint
from swarmtwin.diagnosis.noise_filter import Chains, NoiseFilter

CAMERA = np.array([0.8, 0.8, 2e-4])


@pytest.fixture
def rng():
    return np.random.default_rng(5)


def filter_of(rng, chains):
    """A filter of chains of transitions, with A (N, 3, 3) and the motion's covariances (N, 3, 3)."""
    count = sum(map(len, chains))
    ahead = inverse_adjoint(rng.normal(size=(count, 3)) * [40, 5, 0.8])
    root = rng.normal(size=(count, 3, 3)) * [1.0, 0.5, 0.02]
    motion = root.transpose(0, 2, 1) @ root + np.diag([0.1, 0.1, 1e-4])
    return NoiseFilter.prepared(Chains.of(chains), -ahead, motion, CAMERA), ahead, motion


def joint_covariance(chain, ahead, motion):
    """(3 n, 3 n) of the errors e_t = −A_t ε_t + η_t + ε_{t+1} of one chain."""
    count = len(chain)
    mixed = np.zeros((3 * count, 3 * (count + 1)))
    covariance = np.zeros((3 * count, 3 * count))
    for number, row in enumerate(chain):
        own = slice(3 * number, 3 * number + 3)
        mixed[own, own], mixed[own, 3 * number + 3 : 3 * number + 6] = -ahead[row], np.eye(3)
        covariance[own, own] = motion[row]
    return covariance + mixed @ np.diag(np.tile(CAMERA, count + 1)) @ mixed.T


def by_steps(prepared, errors, history):
    """(N, 3, k) the filter's recursion in plain numpy."""
    whitened = np.zeros_like(errors)
    for chain in np.split(prepared.chains.rows, prepared.chains.ends[1:-1]):
        expected = np.zeros(errors.shape[1:])
        for row in chain:
            shift = prepared.carry[row] @ expected
            whitened[row] = prepared.whiten[row] @ (errors[row] - shift)
            expected = prepared.gain[row] @ (history[row] - shift)
    return whitened


def test_it_whitens_by_the_root_of_the_joint_covariance(rng):
    """Chains in any order of rows: its errors are the inverse Cholesky factor times the errors."""
    rows = rng.permutation(18)
    chains = [rows[:7], rows[7:8], rows[8:]]
    prepared, ahead, motion = filter_of(rng, chains)
    errors = rng.normal(size=(18, 3, 4))
    whitened = prepared(errors)
    for chain in chains:
        root = np.linalg.cholesky(joint_covariance(chain, ahead, motion))
        expected = np.linalg.solve(root, errors[chain].reshape(-1, 4))
        np.testing.assert_allclose(whitened[chain].reshape(-1, 4), expected, rtol=1e-9, atol=1e-9)
        assert np.isclose(prepared.log_volume[chain].sum(), np.log(np.diag(root)).sum())


def test_errors_are_standardised_by_another_history(rng):
    prepared, _, _ = filter_of(rng, np.split(np.arange(30), [12, 13]))
    errors, history = rng.normal(size=(2, 30, 3, 4))
    np.testing.assert_allclose(prepared.with_history(errors, history), by_steps(prepared, errors, history), atol=1e-10)


def test_columns_need_not_lie_side_by_side(rng):
    prepared, _, _ = filter_of(rng, [np.arange(10)])
    errors = rng.normal(size=(4, 3, 10)).transpose(2, 1, 0)
    np.testing.assert_array_equal(prepared(errors), prepared(errors.copy()))


def test_the_inverse_leads_back(rng):
    prepared, _, _ = filter_of(rng, np.split(rng.permutation(40), [3, 25]))
    errors = rng.normal(size=(40, 3))
    np.testing.assert_allclose(prepared.inverse(prepared(errors[..., None])[..., 0]), errors, atol=1e-9)


def test_no_transitions_are_no_errors():
    prepared = NoiseFilter.prepared(Chains.of([]), np.zeros((0, 3, 3)), np.zeros((0, 3, 3)), CAMERA)
    assert prepared(np.zeros((0, 3, 2))).shape == (0, 3, 2)
