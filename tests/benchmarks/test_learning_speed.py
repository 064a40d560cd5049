"""How fast policies are learned: figures to look at with `pytest -s -m benchmark_figures`."""

import time

import numpy as np
import pytest
import stable_baselines3

from swarmtwin.learning.device import one_thread
from swarmtwin.policies.algorithms import ddpg, td3
from swarmtwin.policies.checkpoint import global_rng_kept
from swarmtwin.policies.training import Learner
from tiny_policies import algorithm_named, policy_job, robot_named, simulation, task_named

ROUNDS = 8
PERIODS = 25


def as_before(name):
    """An algorithm of stable-baselines3 as it comes: Adam parameter by parameter, one noise for each vehicle."""

    def build(policy_kwargs, action_noise, **arguments):
        policy_kwargs = {key: value for key, value in policy_kwargs.items() if key != "optimizer_kwargs"}
        kind = getattr(stable_baselines3, name.upper())
        return kind(**arguments, policy_kwargs=policy_kwargs, action_noise=action_noise.base_noise)

    return build


def learners(folder, monkeypatch, module, name):
    """Two that learn to meet with a shipped algorithm: with lean updates, and with those of stable-baselines3."""
    algorithm = algorithm_named(name, random_steps=1, buffer_size=100_000)
    job = policy_job(folder, task_named("collective"), algorithm, every=1_000_000, scenes=1)
    lean = Learner(job)
    monkeypatch.setattr(module, f"Lean{name.upper()}", as_before(name))
    return {"lean": lean, "stable-baselines3": Learner(job)}


def measured_s(learner):
    """How long a control period and a gradient step take this process, in seconds."""
    algorithm = learner.algorithm
    start = time.process_time()
    algorithm.learn(PERIODS * learner.env.num_envs, log_interval=None, reset_num_timesteps=False)
    between = time.process_time()
    algorithm.train(PERIODS, algorithm.batch_size)
    return (between - start) / PERIODS, (time.process_time() - between) / PERIODS


@pytest.mark.benchmark_figures
@pytest.mark.parametrize("module", [ddpg, td3])
def test_speed_of_learning_to_meet(tmp_path, monkeypatch, module):
    folder = simulation(tmp_path / "kinematic", robot_named("mgr"))
    name = module.__name__.rpartition(".")[2]
    measured = {"lean": [], "stable-baselines3": []}
    with one_thread(), global_rng_kept():
        both = learners(folder, monkeypatch, module, name)
        for _ in range(ROUNDS):
            for kind, learner in both.items():
                measured[kind].append(measured_s(learner))
    best = {kind: np.min(seconds, axis=0) for kind, seconds in measured.items()}
    print(f"\n{name}, collective, one thread: lean : stable-baselines3")
    for what, lean, plain in zip(("control period", "gradient step"), *best.values(), strict=True):
        print(f"{what:>15}   {lean / plain:.2f}   ({1e3 * lean:.2f} ms : {1e3 * plain:.2f} ms)")
        assert lean > 0
