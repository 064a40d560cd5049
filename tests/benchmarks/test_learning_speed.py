"""How fast policies and models are learned: figures to look at with `pytest -s -m benchmark_figures`."""

import time

import numpy as np
import pytest
import stable_baselines3
import torch

from swarmtwin.dynamics.model_config import config_class
from swarmtwin.dynamics.training import train
from swarmtwin.learning.device import one_thread
from swarmtwin.learning.trainer_settings import TrainerSettings
from swarmtwin.policies.algorithms import ddpg, td3
from swarmtwin.policies.checkpoint import global_rng_kept
from swarmtwin.policies.training import Learner
from tiny_policies import algorithm_named, policy_job, robot_named, simulation, task_named
from toy import recipe, toy_transitions

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


@pytest.mark.benchmark_figures
@pytest.mark.skipif(not torch.cuda.is_available(), reason="torch finds no GPU here")
def test_speed_of_a_models_learning_on_a_gpu(robots):
    """CR-Net, batches of 1,024; on the CPU a tenth of the steps, on one thread."""
    transitions = toy_transitions(robots["mgr"], 20_000, noise=(1.0, 1.0, 0.03))
    step_s = {}
    for device, precision, steps in (("gpu", "32-true", 600), ("gpu", "bf16-mixed", 600), ("cpu", "32-true", 60)):
        trainer, start = TrainerSettings(precision=precision), time.perf_counter()
        config = config_class("crnet")(steps=steps)
        train(transitions, config, recipe(batch_size=1024), [1], None, None, device=device, trainer=trainer)
        step_s[f"{device} {precision}"] = (time.perf_counter() - start) / steps
    print("\ncrnet, milliseconds a step of 1,024 transitions, and in relation to the CPU")
    for name, seconds in step_s.items():
        print(f"{name:>15}   {1e3 * seconds:.1f}   {seconds / step_s['cpu 32-true']:.2f}")
