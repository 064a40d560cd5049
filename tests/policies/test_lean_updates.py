"""Lean gradient steps give the numbers of stable-baselines3's own."""

import numpy as np
import pytest
import stable_baselines3
import torch
from stable_baselines3.common.logger import Logger
from stable_baselines3.common.noise import NormalActionNoise, VectorizedActionNoise

from swarmtwin.policies.algorithms import ddpg, td3
from swarmtwin.policies.lean_updates import LeanDDPG, LeanTD3, SharedGaussianNoise
from swarmtwin.policies.training import Learner
from tiny_policies import policy_job, robot_named, simulation, small

NOISY = {"policy_delay": 3, "target_policy_noise": 0.4, "target_noise_clip": 0.5}
CASES = {
    "ddpg": (LeanDDPG, stable_baselines3.DDPG, {}),
    "td3": (LeanTD3, stable_baselines3.TD3, NOISY),
    "td3 of one critic": (LeanTD3, stable_baselines3.TD3, {**NOISY, "policy_kwargs": {"n_critics": 1}}),
    "td3 over three periods": (LeanTD3, stable_baselines3.TD3, {**NOISY, "n_steps": 3}),
    "ddpg that learns ever more slowly": (
        LeanDDPG,
        stable_baselines3.DDPG,
        {"learning_rate": lambda left: left / 1e3},
    ),
}


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    return simulation(tmp_path_factory.mktemp("simulation") / "kinematic", robot_named("mgr"))


@pytest.fixture(scope="module")
def env(folder):
    return Learner(policy_job(folder)).env


def built(kind, env, changes):
    """An algorithm that remembers 50 control periods of invented experience."""
    algorithm = kind("MlpPolicy", env, seed=1, buffer_size=10_000, tau=0.05, gamma=0.9, **changes)
    algorithm.set_logger(Logger(folder=None, output_formats=[]))
    random = np.random.default_rng(0)
    memory = algorithm.replay_buffer
    memory.pos = 50
    for values in (memory.observations, memory.next_observations, memory.rewards):
        values[:50] = random.normal(size=values[:50].shape)
    memory.actions[:50] = random.uniform(-1, 1, memory.actions[:50].shape)
    memory.dones[:50] = random.random(memory.dones[:50].shape) < 0.2
    memory.timeouts[:50] = memory.dones[:50] * (random.random(memory.dones[:50].shape) < 0.5)
    return algorithm


def weights(algorithm):
    return {name: values.clone() for name, values in algorithm.policy.state_dict().items()}


def distances(some, others):
    """Of each layer's weights and biases."""
    return np.array([torch.dist(some[name], others[name]).item() for name in some])


@pytest.mark.parametrize("case", CASES)
def test_gradient_steps_are_those_of_stable_baselines3(env, case):
    lean_kind, kind, changes = CASES[case]
    lean, plain = built(lean_kind, env, changes), built(kind, env, changes)
    before = weights(plain)
    assert not distances(weights(lean), before).any()
    for algorithm in (lean, plain):
        np.random.seed(2)  # noqa: NPY002
        torch.manual_seed(2)
        for left in (1.0, 0.5, 0.25):
            algorithm._current_progress_remaining = left
            algorithm.train(4, batch_size=64)
    moved = distances(weights(plain), before)
    assert (distances(weights(lean), weights(plain)) < 1e-3 * moved).all()
    assert lean._n_updates == plain._n_updates == 12


@pytest.mark.parametrize(("module", "name"), [(ddpg, "ddpg"), (td3, "td3")])
def test_learning_is_that_of_stable_baselines3(folder, monkeypatch, module, name):
    job = policy_job(folder, algorithm=small(name, exploration=0.2, last_exploration=0.2))
    lean = job.run(None)
    monkeypatch.setattr(module, f"Lean{name.upper()}", getattr(stable_baselines3, name.upper()))
    monkeypatch.setattr(module.Config, "noise", lambda self, env: NormalActionNoise(np.zeros(2), np.full(2, 0.2)))
    plain = job.run(None)
    rewards = [[evaluation.reward for evaluation in result.history] for result in (lean, plain)]
    assert rewards[0] == pytest.approx(rewards[1], rel=1e-4)
    assert len({round(reward, 2) for reward in rewards[0]}) == 3


def test_noise_is_that_of_one_noise_for_each_vehicle(env):
    shared = SharedGaussianNoise(env, 0.3, 0.3, 100)
    one_each = VectorizedActionNoise(NormalActionNoise(np.zeros(2), np.full(2, 0.3)), env.num_envs)
    drawn = []
    for noise in (shared, one_each):
        np.random.seed(3)  # noqa: NPY002
        drawn.append([noise(), noise()])
    assert np.array_equal(*drawn)
    assert drawn[0][0].dtype == np.float32


def test_noise_falls_evenly_over_the_training_and_then_stays(env):
    noise = SharedGaussianNoise(env, 0.4, 0.1, 100)
    assert noise.spread == 0.4
    for step, spread in ((0, 0.4), (50, 0.25), (100, 0.1), (150, 0.1)):
        noise.reach(step)
        assert noise.spread == pytest.approx(spread)


@pytest.mark.parametrize("name", ["ddpg", "td3"])
def test_vehicles_explore_as_much_as_the_configuration_says_at_the_time(folder, name):
    job = policy_job(folder, algorithm=small(name, steps=400, exploration=0.2, last_exploration=0.0))
    learner = Learner(job)
    learner.begin()
    spreads = {}
    for steps in (200, 400):
        learner.learn_until(steps, None, lambda: None)
        spreads[steps] = learner.algorithm.action_noise.spread
    assert spreads[200] == pytest.approx(0.1, abs=0.002)
    assert spreads[400] == pytest.approx(0.0, abs=0.002)


@pytest.mark.parametrize(("kind", "actor_learns"), [(LeanDDPG, 7), (LeanTD3, 8)])
def test_the_actor_waits_until_the_critic_has_learned(env, kind, actor_learns):
    algorithm = built(kind, env, {})
    algorithm.critic_updates = 6
    moved = {}
    for step in range(1, 9):
        before = weights(algorithm)
        algorithm.train(1, batch_size=64)
        now = weights(algorithm)
        moved[step] = {
            part
            for part in ("actor.", "critic.")
            if any(not torch.equal(now[name], before[name]) for name in now if name.startswith(part))
        }
    assert all("critic." in parts for parts in moved.values())
    assert next(step for step, parts in moved.items() if "actor." in parts) == actor_learns


def test_noise_stays_as_it_is_unless_it_is_told_to_change(folder):
    noise = Learner(policy_job(folder, algorithm=small("ddpg", exploration=0.1))).algorithm.action_noise
    assert (noise.first, noise.last) == (0.1, 0.1)
