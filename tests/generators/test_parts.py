"""The parts that generators are made of, each against mathematics."""

import numpy as np
import pytest
import torch

from swarmtwin.generators.columns import Columns
from swarmtwin.generators.denoiser import Denoiser
from swarmtwin.generators.marginal_distributions import MarginalDistributions


@pytest.fixture(autouse=True)
def _seeded():
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(0)
        yield


def test_diffusion_without_a_network_draws_a_normal_distribution_exactly():
    denoiser = Denoiser(2, 0, 8)
    with torch.no_grad():
        for weights in denoiser.parameters():
            weights.zero_()
    source, again = (torch.Generator().manual_seed(1) for _ in range(2))
    drawn = denoiser.sample(torch.empty(1000, 0), 4, source)
    torch.testing.assert_close(drawn, torch.randn(1000, 2, generator=again))


def test_diffusion_learns_two_humps_whose_place_depends_on_the_condition():
    denoiser = Denoiser(1, 1, 64)
    optimiser = torch.optim.Adam(denoiser.parameters(), lr=5e-3)
    for _ in range(800):
        side = torch.randint(0, 2, (512, 1)).float() * 2 - 1
        condition = torch.randint(0, 2, (512, 1)).float()
        loss = denoiser.loss(side * (0.6 + 0.6 * condition) + 0.05 * torch.randn(512, 1), condition)
        optimiser.zero_grad()
        loss.backward()
        optimiser.step()
    for condition, place in ((0.0, 0.6), (1.0, 1.2)):
        with torch.inference_mode():
            drawn = denoiser.sample(torch.full((2000, 1), condition), 12, torch.Generator().manual_seed(2))
        assert drawn.abs().mean().item() == pytest.approx(place, abs=0.06)
        assert (drawn.abs() < place / 2).float().mean().item() < 0.05
        assert (drawn > 0).float().mean().item() == pytest.approx(0.5, abs=0.07)


def test_marginals_return_limits_repeated_values_and_steps():
    uniform = torch.rand(5000) * 240 - 120
    values = torch.stack([uniform, (uniform * 10).round() / 10, torch.where(uniform > 0, 5.0, uniform)], dim=1)
    marginals = MarginalDistributions(3, 129)
    marginals.learn(values)
    drawn = marginals.values(torch.randn(20000, 3))
    low, high = values.min(dim=0).values, values.max(dim=0).values
    assert torch.all((low - 1e-4 <= drawn) & (drawn <= high + 1e-4))
    torch.testing.assert_close(drawn.min(dim=0).values.float(), low, atol=0.2, rtol=0)
    torch.testing.assert_close(drawn.max(dim=0).values.float(), high, atol=0.2, rtol=0)
    assert torch.equal(drawn[:, 1], drawn[:, 1].round(decimals=1))
    assert not torch.equal(drawn[:, 0], drawn[:, 0].round(decimals=3))
    assert (drawn[:, 2] == 5).double().mean().item() == pytest.approx(0.5, abs=0.02)


def test_scores_are_normal_whatever_the_values_and_keep_their_order():
    values = torch.stack([torch.rand(4001) ** 5, (torch.rand(4001) * 3).round()], dim=1)
    scores = MarginalDistributions.scores(values)
    assert torch.equal(scores[:, 0].argsort(), values[:, 0].argsort())
    assert scores.mean(dim=0).tolist() == pytest.approx([0, 0], abs=1e-3)
    assert scores.std(dim=0).tolist() == pytest.approx([1, 1], abs=0.01)
    assert scores[values[:, 1] == 0, 1].max() < scores[values[:, 1] == 3, 1].min()


def test_believable_is_what_prepare_keeps(robots):
    columns = Columns.of(robots["mur"])
    good = np.array([10.0, 30, 5, 500, 500, 1, 20, 5, 0.3])
    assert columns.believable(good[None]).all()
    for column, value in ((0, 80), (2, 2.9), (3, -200), (4, 1200), (6, 101), (8, -2.1), (7, np.nan), (5, 4.0)):
        changed = good.copy()
        changed[column] = value
        assert not columns.believable(changed[None]).any(), (column, value)
