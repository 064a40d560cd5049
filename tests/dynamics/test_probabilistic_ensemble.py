"""A probabilistic ensemble: planted noise is recovered, its spread is calibrated, and vehicles differ as members do."""

import dataclasses

import numpy as np
import pytest
import torch

from swarmtwin.dynamics.mean_variance import MeanVarianceEnsemble
from swarmtwin.dynamics.model_config import config_class
from swarmtwin.dynamics.motion_noise import MotionNoise
from swarmtwin.dynamics.spread import Mixture, SpreadFigure, calibrate_spread
from swarmtwin.dynamics.training import train
from swarmtwin.errors import UserError
from swarmtwin.learning.ensemble import bootstrap_counts
from swarmtwin.learning.situation import Situation
from swarmtwin.simulation.displacement_table import TableSettings, tabulated
from swarmtwin.simulation.simulation import MEMBER, Simulation
from swarmtwin.world.motion import SimulatedMotion
from toy import exact_displacement, recipe, toy_transitions


def planted_sd(command):
    """Standard deviations (N, 3) that grow with the effort, by a factor of six: mm, mm, rad."""
    effort = np.abs(command).mean(axis=1, keepdims=True) / 120
    return (0.5 + 2.5 * effort) * np.array([1.0, 0.5, 0.02])


def noisy(robot, count, seed=0, factor=1.0):
    transitions = toy_transitions(robot, count, seed=seed)
    drawn = np.random.default_rng(seed + 1).normal(size=(count, 3)) * factor * planted_sd(transitions.command)
    return dataclasses.replace(transitions, displacement=transitions.displacement + drawn)


@pytest.fixture(scope="module")
def trained(robots):
    transitions = noisy(robots["mgr"], 8000)
    config = config_class("probabilistic_ensemble")(members=3, layers=(48, 48), steps=600)
    return train(transitions, config, recipe(batch_size=256), [1]).dynamics


def test_noise_that_grows_with_the_command_is_recovered(trained, robots):
    unseen = noisy(robots["mgr"], 2000, seed=7)
    _, variance = trained.moments(Situation.from_transitions(unseen, trained.inputs))
    ratio = np.sqrt(variance.mean(dim=0).numpy()) / planted_sd(unseen.command)
    np.testing.assert_allclose(np.median(ratio, axis=0), 1.0, atol=0.1)
    assert (ratio.std(axis=0) < 0.2).all()


def test_intervals_hold_the_share_that_they_state(trained, robots):
    figure = SpreadFigure.of(Mixture.of(trained, noisy(robots["mgr"], 4000, seed=8)))
    for share in (0.5, 0.9, 0.95):
        assert figure.covered(share) == pytest.approx(share, abs=0.03)


def test_calibration_finds_the_factor_that_the_noise_grew_by(trained, robots):
    before = trained.network.spread_factor.clone()
    try:
        calibrate_spread(trained, noisy(robots["mgr"], 3000, seed=9))
        as_learned = trained.network.spread_factor.clone()
        calibrate_spread(trained, noisy(robots["mgr"], 3000, seed=9, factor=1.7))
        np.testing.assert_allclose((trained.network.spread_factor / as_learned).numpy(), 1.7, rtol=0.03)
    finally:
        trained.network.spread_factor.copy_(before)


def test_the_likelihood_of_a_known_mixture_is_that_of_its_formula():
    residual = np.array([[[1.0, 0.0, 0.1]], [[-1.0, 0.0, 0.1]]])
    mixture = Mixture(residual, np.broadcast_to([4.0, 1.0, 0.01], residual.shape))
    terms = [
        np.prod(np.exp(-(r**2) / (2 * v)) / np.sqrt(2 * np.pi * v))
        for r, v in zip(residual[:, 0], mixture.variance[:, 0], strict=True)
    ]
    np.testing.assert_allclose(mixture.log_density(), np.log(np.mean(terms)))
    np.testing.assert_allclose(mixture.cumulative()[0, :2], 0.5)


def test_the_weight_of_the_variance_keeps_gradients_of_the_mean_from_fading():
    """With β = 1 the mean is learned as by least squares: its gradient does not hang on the variance."""
    torch.manual_seed(0)
    inputs, outputs, counts = torch.randn(64, 2), torch.randn(64, 3), torch.ones(64, 2)
    network = MeanVarianceEnsemble(2, members=2, layers=(8,), variance_weight=1.0)
    network.loss(inputs, outputs, counts).backward()
    of_mean = network.perceptrons.parts[0][-1].bias.grad[..., :3].clone()
    mean, _ = network.moments(inputs)
    expected = (mean - outputs).mean(dim=1) / (2 * 3)
    torch.testing.assert_close(of_mean[:, 0], expected.detach())


def test_a_bootstrap_draws_whole_runs_of_one_vehicle_for_each_member():
    vehicle, run = np.repeat([0, 1, 2], 400), np.arange(1200) // 20
    counts = bootstrap_counts(vehicle, run, members=201, seed=3)
    for number in np.unique(run):
        assert (counts[run == number] == counts[run == number][0]).all()
    of_vehicle = np.array([counts[vehicle == number].sum(axis=0) for number in range(3)])
    assert (np.sort(of_vehicle, axis=0) == [[0], [0], [400]]).all()
    assert ((of_vehicle > 0).sum(axis=1) == 67).all()
    assert np.array_equal(counts, bootstrap_counts(vehicle, run, members=201, seed=3))


def test_a_bootstrap_of_one_vehicle_leaves_out_what_chance_leaves_out():
    counts = bootstrap_counts(np.zeros(1200, int), np.arange(1200) // 20, members=200, seed=3)
    np.testing.assert_allclose((counts == 0).mean(), np.exp(-1), atol=0.02)
    assert (counts.sum(axis=0) == 1200).all()


def test_more_vehicles_than_members_are_shared_out():
    counts = bootstrap_counts(np.repeat(np.arange(6), 50), np.arange(300) // 10, members=3, seed=3)
    seen = np.array([counts[50 * number : 50 * number + 50].sum(axis=0) > 0 for number in range(6)])
    assert (seen.sum(axis=1) == 1).all()
    assert (seen.sum(axis=0) == 2).all()


def test_members_of_unlike_vehicles_differ_as_the_vehicles_do(robots):
    """Four vehicles whose wheels differ by a tenth: members spread as far, those of one vehicle much less."""
    base = noisy(robots["mgr"], 6000)
    gain = np.array([0.85, 0.95, 1.05, 1.15])
    vehicle = np.arange(6000) // 50 % 4
    unlike = dataclasses.replace(
        base,
        vehicle=vehicle,
        vehicles=("1", "2", "3", "4"),
        displacement=base.displacement * gain[vehicle][:, None],
        split=np.where(np.arange(6000) // 200 % 5 == 4, 1, 0),
    )
    config = config_class("probabilistic_ensemble")(members=8, layers=(32,), steps=300)
    ahead = Situation(command=torch.tensor([[100.0, 100.0]]))
    spreads = []
    for transitions in (unlike, base):
        mean, _ = train(transitions, config, recipe(batch_size=256), [1]).dynamics.moments(ahead)
        spreads.append(float(mean[:, 0, 0].std() / mean[:, 0, 0].mean()))
    assert spreads[0] == pytest.approx(gain.std(ddof=1), rel=0.3)
    assert spreads[1] < 0.3 * spreads[0]


def test_a_vehicle_keeps_the_member_that_it_drew_and_another_roll_out_draws_anew(trained):
    simulation = Simulation(trained)
    rng = torch.Generator().manual_seed(0)
    state = simulation.start(torch.zeros(40, 3, 3), rng=rng)
    drawn = state.memory[MEMBER]
    assert set(drawn.flatten().tolist()) == {0, 1, 2}
    for _ in range(3):
        state = simulation.step(state, torch.full((40, 3, 2), 60.0, dtype=torch.float64), rng=rng)
        assert torch.equal(state.memory[MEMBER], drawn)
    assert not torch.equal(simulation.start(torch.zeros(40, 3, 3), rng=rng).memory[MEMBER], drawn)


def test_sampled_motion_has_mean_and_spread_of_the_member(trained):
    command = torch.tensor([[90.0, 60.0]]).double()
    mean, variance = trained.moments(Situation(command=command))
    for member in (0, 2):
        rows = Situation(command=command.expand(20_000, 2))
        drawn = trained.sample(rows, torch.Generator().manual_seed(1), torch.full((20_000,), member))
        camera = 2 * torch.tensor(trained.motion_noise.camera).double()
        spread = (variance[member, 0] - camera).clamp(min=0).sqrt()
        assert ((drawn.mean(dim=0) - mean[member, 0]).abs() < 4 * spread / 20_000**0.5).all()
        torch.testing.assert_close(drawn.std(dim=0), spread, rtol=0.03, atol=1e-6)


def test_the_camera_s_noise_is_in_what_is_measured_and_not_in_the_motion(trained, robots):
    command = torch.full((20_000, 2), 100.0).double()
    _, variance = trained.moments(Situation(command=command))
    noise = trained.motion_noise
    camera = float(variance[0, 0, 0]) / 4
    trained.motion_noise = MotionNoise(**{**noise.model_dump(), "camera": (camera, camera, 0.0)})
    try:
        one = torch.zeros(20_000, dtype=torch.long)
        drawn = trained.sample(Situation(command=command), torch.Generator().manual_seed(1), one)
    finally:
        trained.motion_noise = noise
    assert float(drawn[:, 0].var()) == pytest.approx(float(variance[0, 0, 0]) / 2, rel=0.05)


def test_without_random_numbers_the_most_likely_motion_is_the_mean_of_all_members(trained):
    simulation, command = Simulation(trained), torch.full((2, 1, 2), 70.0).double()
    moved = simulation.step(simulation.start(torch.zeros(2, 1, 3), rng=torch.Generator().manual_seed(0)), command)
    expected = exact_displacement(np.full((1, 2), 70.0))[0]
    np.testing.assert_allclose(moved.pose[0, 0].numpy()[:2], expected[:2], atol=0.7)
    torch.testing.assert_close(moved.pose[0], moved.pose[1], rtol=1e-6, atol=1e-6)  # its network is float32


def test_a_world_samples_it_and_restores_who_is_who(trained):
    motion = SimulatedMotion(Simulation(trained), worlds=3, vehicles=2, sampled=True, seed=4)
    motion.place(np.arange(3), np.zeros((3, 2, 3)))
    command = np.full((3, 2, 2), 80.0)
    motion.move(command)
    kept = motion.state()
    expected = motion.move(command)
    other = SimulatedMotion(Simulation(trained), worlds=3, vehicles=2, sampled=True, seed=9)
    other.restore(kept)
    assert np.array_equal(other.move(command), expected)


def test_a_table_would_lose_the_spread_and_is_refused(trained):
    with pytest.raises(UserError, match="states a spread of its own, by which vehicles differ"):
        tabulated(Simulation(trained), TableSettings())
    simulation = Simulation(trained)
    assert tabulated(simulation, TableSettings(), None) is simulation
