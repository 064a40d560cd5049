"""The reference's noise: what is planted is standardised to one, and what lasts is taken off."""

import numpy as np
import pytest
import torch
from exact_base import SPREAD, ExactBase, session_of

from swarmtwin.diagnosis.noise import Noise


class SlidingBase(ExactBase):
    """Slides a little to the side when it turns."""

    def twist(self, command):
        twist = super().twist(command)
        return twist + twist[:, 2:] * torch.tensor([[0.0, 5.0, 0.0]], dtype=torch.float64)


def growing(way):
    """Noise that grows with the motion, ahead with speed, in turning with the turn."""
    ahead, turn = way[:, :1].abs() / 20, way[:, 2:].abs() / 0.4
    return torch.cat([0.5 * torch.exp(0.5 * ahead), 0.3 + 0 * ahead, 0.01 * torch.exp(0.5 * turn)], dim=-1)


def residual_and_way(base, session):
    situation = session.situation
    way = base.twist(situation.command)
    return session.residual_of(way), way


def whitened(base, learned_from, session):
    """Standardised residuals (N, 3) of one session by the noise of another."""
    residual, way = residual_and_way(base, learned_from)
    noise = Noise.learn(residual, way, learned_from)
    residual, way = residual_and_way(base, session)
    return noise, noise.whitener(way, session)(residual).numpy()


def neighbouring(values, session, apart=1):
    """Correlation of values (N,) with those `apart` transitions before, in the same run."""
    earlier = np.arange(len(session))
    for _ in range(apart):
        earlier = np.where(earlier >= 0, session.follows[np.maximum(earlier, 0)], -1)
    known = earlier >= 0
    return np.corrcoef(values[known], values[earlier[known]])[0, 1]


def test_noise_that_grows_with_the_motion_is_standardised_everywhere(robots):
    base = SlidingBase(robots["mgr"])
    reference = session_of(base, np.random.default_rng(1), spread=growing, runs=150)
    session = session_of(base, np.random.default_rng(2), spread=growing, runs=150)
    residual, way = residual_and_way(base, session)
    noise, scaled = whitened(base, reference, session)
    np.testing.assert_allclose(scaled.std(axis=0), 1.0, atol=0.05)
    for axis in (0, 2):
        size = way[:, axis].abs().numpy()
        slow, fast = size < np.quantile(size, 0.3), size > np.quantile(size, 0.7)
        raw = residual[:, axis].numpy()
        assert raw[fast].std() > 1.4 * raw[slow].std()
        assert scaled[fast, axis].std() / scaled[slow, axis].std() == pytest.approx(1, abs=0.08)
    assert noise.degrees_of_freedom is None or noise.degrees_of_freedom >= 30


def test_heavy_tails_are_seen(robots):
    base = SlidingBase(robots["mgr"])
    rng = np.random.default_rng(3)

    def tailed(way):
        return torch.tensor(SPREAD) * torch.as_tensor(np.sqrt(5 / rng.chisquare(5, way.shape)))

    session = session_of(base, np.random.default_rng(4), spread=tailed, runs=150)
    noise = Noise.learn(*residual_and_way(base, session), session)
    assert 4 <= noise.degrees_of_freedom <= 7


def test_residuals_of_different_numbers_are_made_independent(robots):
    base = SlidingBase(robots["mgr"])
    reference, session = (session_of(base, np.random.default_rng(seed), runs=100) for seed in (5, 6))
    mixed = torch.tensor([[1.0, 0.0, 0.0], [0.0, 1.0, 0.0], [0.012, 0.0, 1.0]], dtype=torch.float64)
    residual, way = residual_and_way(base, reference)
    noise = Noise.learn(residual @ mixed.T, way, reference)
    residual, way = residual_and_way(base, session)
    raw = residual @ mixed.T
    assert np.corrcoef(raw.numpy().T)[0, 2] > 0.4
    between = np.corrcoef(noise.whitener(way, session)(raw).numpy().T) - np.eye(3)
    assert abs(between).max() < 0.06


def test_poses_measured_wrong_leave_no_correlation_between_neighbours(robots):
    base = SlidingBase(robots["mgr"])
    camera = 0.5 * np.array(SPREAD)
    reference, session = (session_of(base, np.random.default_rng(seed), camera=camera, runs=200) for seed in (7, 8))
    raw = residual_and_way(base, session)[0].numpy()
    noise, scaled = whitened(base, reference, session)
    assert neighbouring(raw[:, 2], session) == pytest.approx(-0.25 / 1.5, abs=0.04)
    assert float(noise.carry[2, 2]) == pytest.approx(-0.25 / 1.5, abs=0.04)
    for axis in range(3):
        assert abs(neighbouring(scaled[:, axis], session)) < 0.06
        assert abs(neighbouring(scaled[:, axis], session, 2)) < 0.06
    np.testing.assert_allclose(scaled.std(axis=0), 1.0, atol=0.05)


def test_a_residual_is_free_of_the_one_before_only_where_that_is_known(robots):
    base = SlidingBase(robots["mgr"])
    session = session_of(base, np.random.default_rng(9), camera=np.array(SPREAD), runs=60)
    apart = session.where(np.arange(len(session)) % 2 == 0)
    assert (apart.follows == -1).all()
    residual, way = residual_and_way(base, session)
    noise = Noise.learn(residual, way, session)
    alone, alone_way = residual_and_way(base, apart)
    whitener = noise.whitener(alone_way, apart)
    expected = alone / whitener.residual_scale @ noise.mixing.T
    torch.testing.assert_close(whitener(alone), expected)


def test_angles_of_residuals_are_wrapped(robots):
    base = SlidingBase(robots["mgr"])
    session = session_of(base, np.random.default_rng(10), runs=10)
    way = session.twist.clone()
    way[:, 2] += 2 * np.pi - 0.01
    torch.testing.assert_close(session.residual_of(way)[:, 2], torch.full((len(session),), 0.01, dtype=torch.float64))


def test_robots_that_never_slide_have_the_same_noise_each_time(robots):
    base = ExactBase(robots["mgr"])
    session = session_of(base, np.random.default_rng(11), camera=np.array(SPREAD), runs=60)
    residual, way = residual_and_way(base, session)
    carried = [Noise.learn(residual, way, session).carry for _ in range(10)]
    for carry in carried:
        torch.testing.assert_close(carry, carried[0])
        assert float(carry[2, 2]) == pytest.approx(-1 / 3, abs=0.06)
