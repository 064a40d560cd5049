"""The reference's noise: motion and camera are told apart, and what is left is independent and of unit size."""

import numpy as np
import pytest
import torch
from exact_base import SPREAD, ExactBase, as_it_is, known_noise, session_of, still

from swarmtwin.diagnosis.noise import Noise, inverse_adjoint, likeliest_scales, log_density, right_jacobian
from swarmtwin.geometry import compose, displacement_between, exp_map, log_map


class SlidingBase(ExactBase):
    """Slides a little to the side when it turns."""

    def twist(self, command):
        twist = super().twist(command)
        return twist + twist[:, 2:] * torch.tensor([[0.0, 5.0, 0.0]], dtype=torch.float64)


def growing(way):
    """Variance that grows with the motion, ahead with speed, in turning with the turn."""
    ahead, turn = way[:, :1] / 20, way[:, 2:] / 0.4
    return torch.cat([0.5 * (1 + ahead**2).sqrt(), 0.3 + 0 * ahead, 0.01 * (1 + 2 * turn**2).sqrt()], dim=-1)


def nearly_none(way):
    return torch.tensor([0.05, 0.05, 0.001], dtype=torch.float64).expand_as(way)


def errors_and_way(base, session):
    """Errors (N, 3) in the frame at each period's end, and the ways (N, 3) that the exact model says."""
    way = base.twist(session.situation.command)
    measured = torch.as_tensor(session.transitions.displacement)
    return log_map(displacement_between(exp_map(way), measured)).numpy(), way.numpy()


def whitened(base, learned_from, session):
    """Errors (N, 3) of one session, made independent by the noise of another."""
    noise = Noise.learn(*errors_and_way(base, learned_from), learned_from)
    errors, way = errors_and_way(base, session)
    return noise, noise.filter(way, session)(errors[..., None])[..., 0]


def neighbouring(values, session, apart=1):
    """Correlation of values (N,) with those `apart` transitions before, in the same run."""
    earlier = np.arange(len(session))
    for _ in range(apart):
        earlier = np.where(earlier >= 0, session.follows[np.maximum(earlier, 0)], -1)
    known = earlier >= 0
    return np.corrcoef(values[known], values[earlier[known]])[0, 1]


def test_the_inverse_adjoint_moves_a_small_motion_behind_a_large_one():
    """exp(ε) exp(v) = exp(v) exp(Ad(exp(v)⁻¹) ε), to first order in ε."""
    rng = np.random.default_rng(1)
    way, small = rng.normal(size=(50, 3)) * [30, 10, 1.0], 1e-6 * rng.normal(size=(50, 3))
    moved, before = exp_map(torch.as_tensor(way)), exp_map(torch.as_tensor(small))
    after = log_map(displacement_between(moved, compose(before, moved))).numpy()
    np.testing.assert_allclose(np.einsum("nij,nj->ni", inverse_adjoint(way), small), after, atol=1e-9)


def test_the_right_jacobian_says_what_a_change_of_a_twist_does():
    rng = np.random.default_rng(2)
    way, change = rng.normal(size=(50, 3)) * [30, 10, 1.0], 1e-6 * rng.normal(size=(50, 3))
    way[0, 2] = 1e-7
    one, other = exp_map(torch.as_tensor(way)), exp_map(torch.as_tensor(way + change))
    expected = log_map(displacement_between(one, other)).numpy()
    np.testing.assert_allclose(np.einsum("nij,nj->ni", right_jacobian(way), change), expected, atol=2e-10)


def test_noise_that_grows_with_the_motion_is_standardised_everywhere(robots):
    base = SlidingBase(robots["mgr"])
    reference = session_of(base, np.random.default_rng(1), spread=growing, runs=150)
    session = session_of(base, np.random.default_rng(2), spread=growing, runs=150)
    errors, way = errors_and_way(base, session)
    noise, scaled = whitened(base, reference, session)
    np.testing.assert_allclose(scaled.std(axis=0), 1.0, atol=0.06)
    for axis in (0, 2):
        size = abs(way[:, axis])
        slow, fast = size < np.quantile(size, 0.3), size > np.quantile(size, 0.7)
        assert errors[fast, axis].std() > 1.3 * errors[slow, axis].std()
        assert scaled[fast, axis].std() / scaled[slow, axis].std() == pytest.approx(1, abs=0.08)
    assert noise.degrees_of_freedom is None


def test_heavy_tails_are_seen(robots):
    base = SlidingBase(robots["mgr"])
    rng = np.random.default_rng(3)

    def tailed(way):
        return torch.tensor(SPREAD) * torch.as_tensor(np.sqrt(5 / rng.chisquare(5, (len(way), 1))))

    session = session_of(base, np.random.default_rng(4), spread=tailed, runs=150)
    noise = Noise.learn(*errors_and_way(base, session), session)
    assert noise.degrees_of_freedom in (4.0, 8.0)


@pytest.mark.parametrize("share", [0.3, 0.7, 1.5])
def test_the_cameras_part_is_told_from_the_motions(robots, share):
    """Vehicles turn by up to a radian a period: the frames must be right, or the parts would mix."""
    base = SlidingBase(robots["mgr"])
    camera = share * np.array(SPREAD)
    reference, session = (session_of(base, np.random.default_rng(seed), camera=camera, runs=200) for seed in (7, 8))
    raw = errors_and_way(base, session)[0]
    noise, scaled = whitened(base, reference, session)
    np.testing.assert_allclose(np.sqrt(noise.camera), camera, rtol=0.15)
    np.testing.assert_allclose(np.sqrt(noise.growth.sum(axis=1)), SPREAD, rtol=0.2)
    assert neighbouring(raw[:, 2], session) == pytest.approx(-(share**2) / (1 + 2 * share**2), abs=0.05)
    for axis in range(3):
        for apart in (1, 2):
            assert abs(neighbouring(scaled[:, axis], session, apart)) < 0.06
    np.testing.assert_allclose(scaled.std(axis=0), 1.0, atol=0.05)


class Disturbed:
    """What disturbs a way disturbs the next one by a fifth as much."""

    def __init__(self, seed, size):
        self.rng, self.size, self.last = np.random.default_rng(seed), torch.as_tensor(size), 0.0

    def __call__(self, moment):
        """True displacements (R, 3)."""
        new = self.size * torch.as_tensor(self.rng.normal(size=moment.way.shape))
        self.last = new + (0.0 if moment.step == 0 else 0.2 * self.last)
        return exp_map(moment.way + self.last)


def test_a_camera_that_errs_more_is_told_from_the_motion_where_lasting_disturbances_hid_it(robots):
    base, spread = SlidingBase(robots["mgr"]), np.array(SPREAD)

    def session(seed, camera):
        disturbed = Disturbed(seed, 2 * spread)
        return session_of(base, np.random.default_rng(seed), disturbed, as_it_is, still, camera * spread, runs=200)

    reference, alike, blurred = session(1, 0.5), session(2, 0.5), session(3, 2.0)
    noise = Noise.learn(*errors_and_way(base, reference), reference)
    assert np.all(np.sqrt(noise.camera) < 0.35 * spread)  # hidden: neighbouring errors are alike
    scales = [likeliest_scales(noise, *errors_and_way(base, one), one, spread=1.0) for one in (alike, blurred)]
    assert scales[0].motion == pytest.approx(1.0, abs=0.1)
    assert scales[1].motion == pytest.approx(1.0, abs=0.3)  # what lasts takes a part of it
    assert np.sqrt(noise.scaled(scales[1]).camera) == pytest.approx(2.0 * spread, rel=0.3)


def test_unlike_wheels_make_way_ahead_and_turn_go_together(robots):
    """Each wheel slips by a share of its own way: ahead and turn are correlated where one goes faster."""
    base = SlidingBase(robots["mgr"])
    rng = np.random.default_rng(5)

    def slipping(moment):
        wheels = torch.as_tensor(1 + 0.08 * rng.normal(size=(len(moment.command), 2)))
        return exp_map(base.twist(moment.command * wheels))

    reference, session = (
        session_of(base, np.random.default_rng(seed), slipping, spread=nearly_none, runs=150) for seed in (6, 7)
    )
    errors, way = errors_and_way(base, session)
    scaled = whitened(base, reference, session)[1]
    faster = way[:, 0] * way[:, 2] > np.quantile(abs(way[:, 0] * way[:, 2]), 0.6)
    assert abs(np.corrcoef(errors[faster][:, [0, 2]].T)[0, 1]) > 0.3
    assert abs(np.corrcoef(scaled[faster][:, [0, 2]].T)[0, 1]) < 0.15


def test_the_likelihood_is_that_of_the_joint_normal_distribution(robots):
    """Against the whole covariance matrix of one run, written down here."""
    base = SlidingBase(robots["mgr"])
    session = session_of(base, np.random.default_rng(9), camera=np.array(SPREAD), runs=1, steps=12)
    noise = known_noise()
    noise = Noise(noise.usual, noise.growth, 0.0, np.array([0.8, 0.8, 3e-4]), None)
    errors, way = errors_and_way(base, session)
    count, adjoint = len(session), inverse_adjoint(way)
    to_errors = np.zeros((3 * count, 3 * (count + 1)))
    for step in range(count):
        rows = slice(3 * step, 3 * step + 3)
        to_errors[rows, rows], to_errors[rows, 3 * step + 3 : 3 * step + 6] = -adjoint[step], np.eye(3)
    covariance = to_errors @ np.diag(np.tile(noise.camera, count + 1)) @ to_errors.T
    for step, jacobian in enumerate(right_jacobian(way)):
        rows = slice(3 * step, 3 * step + 3)
        covariance[rows, rows] += jacobian @ np.diag(np.array(SPREAD) ** 2) @ jacobian.T
    expected = -0.5 * errors.ravel() @ np.linalg.solve(covariance, errors.ravel())
    expected -= 0.5 * (np.linalg.slogdet(covariance)[1] + 3 * count * np.log(2 * np.pi))
    assert noise.log_likelihood(errors, way, session) == pytest.approx(expected, rel=1e-9)


def test_densities_integrate_to_one():
    line = np.linspace(-40, 40, 161)
    grid = np.stack(np.meshgrid(line, line, line, indexing="ij"), axis=-1)
    for freedom in (None, 8.0):
        assert np.exp(log_density(grid, freedom)).sum() * 0.5**3 == pytest.approx(1, abs=0.01)


def test_transitions_apart_are_filtered_apart(robots):
    base = SlidingBase(robots["mgr"])
    session = session_of(base, np.random.default_rng(9), camera=np.array(SPREAD), runs=60)
    apart = session.where(np.arange(len(session)) % 2 == 0)
    assert (apart.follows == -1).all()
    errors, way = errors_and_way(base, session)
    noise = Noise.learn(errors, way, session)
    alone, alone_way = errors_and_way(base, apart)
    covariance = noise.motion_covariance(alone_way) + np.diag(noise.camera)
    adjoint = inverse_adjoint(alone_way)
    covariance += adjoint * noise.camera @ adjoint.transpose(0, 2, 1)
    expected = np.einsum("nij,nj->ni", np.linalg.inv(np.linalg.cholesky(covariance)), alone)
    np.testing.assert_allclose(noise.filter(alone_way, apart)(alone[..., None])[..., 0], expected)


def test_angles_of_residuals_are_wrapped(robots):
    base = SlidingBase(robots["mgr"])
    session = session_of(base, np.random.default_rng(10), runs=10)
    way = session.twist.clone()
    way[:, 2] += 2 * np.pi - 0.01
    torch.testing.assert_close(session.residual_of(way)[:, 2], torch.full((len(session),), 0.01, dtype=torch.float64))
