"""Learning on a GPU as on a CPU; what it leaves is used without one. Skipped where torch finds no GPU."""

import numpy as np
import pytest
import torch

from generators.plant import brief_config, planted
from swarmtwin.dynamics.model_config import config_class
from swarmtwin.dynamics.training import train
from swarmtwin.generators.sampling import draw_believable
from swarmtwin.generators.training import fit
from swarmtwin.learning.trainer_settings import TrainerSettings
from tiny_policies import policy_job, robot_named, simulation, small
from toy import recipe, toy_transitions

pytestmark = pytest.mark.skipif(not torch.cuda.is_available(), reason="torch finds no GPU here")

NOISE = (1.0, 1.0, 0.03)


@pytest.fixture(scope="module")
def transitions(robots):
    return toy_transitions(robots["mgr"], 1200, noise=NOISE)


def trained(transitions, device, name="mlp", precision="32-true", checkpoints=None, report=None, seed=1):
    """A model trained for a few epochs, one seed."""
    trainer = TrainerSettings(precision=precision)
    config = config_class(name)(steps=40)
    return train(
        transitions, config, recipe(batch_size=120), [seed], checkpoints, report, device=device, trainer=trainer
    ).best


def error_of(trained_model):
    """Its error on validation runs in the end, mm."""
    return trained_model.history[-1].validation_position_mm


@pytest.mark.parametrize("precision", ["32-true", "bf16-mixed"])
@pytest.mark.parametrize("name", ["mlp", "lstm"])
def test_a_dynamics_model_learns_nearly_the_same(transitions, name, precision):
    on_cpu, on_gpu = (trained(transitions, device, name, precision) for device in ("cpu", "gpu"))
    assert error_of(on_gpu) == pytest.approx(error_of(on_cpu), rel=0.1)
    assert all(isinstance(weights, np.ndarray) for weights in on_gpu.weights.values())


@pytest.mark.parametrize("precision", ["32-true", "bf16-mixed"])
def test_crnet_whose_random_numbers_are_others_there_learns_as_other_seeds_do(transitions, precision):
    on_cpu = [error_of(trained(transitions, "cpu", "crnet", precision, seed=seed)) for seed in range(1, 6)]
    assert error_of(trained(transitions, "gpu", "crnet", precision)) < max(on_cpu)


def test_an_interrupted_training_goes_on_to_what_it_would_have_become(transitions, tmp_path):
    def interrupt(seed, epoch, errors):
        if epoch == 4:
            raise KeyboardInterrupt

    undisturbed = trained(transitions, "gpu")
    with pytest.raises(KeyboardInterrupt):
        trained(transitions, "gpu", checkpoints=tmp_path, report=interrupt)
    resumed = trained(transitions, "gpu", checkpoints=tmp_path)
    np.testing.assert_allclose(np.array(resumed.history), np.array(undisturbed.history), rtol=1e-3)


@pytest.mark.parametrize("name", ["gan", "residual_diffusion"])
def test_a_generator_lies_on_the_cpu_afterwards(robots, name):
    generator, _ = fit(planted(robots["mgr"]), brief_config(name), seed=1, device="gpu")
    assert {weights.device.type for weights in generator.state_dict().values()} == {"cpu"}
    rows = draw_believable(generator, 200, seed=3).rows
    assert np.isfinite(rows).all()


def test_a_policy_learns_and_goes_on(tmp_path):
    folder = simulation(tmp_path / "kinematic", robot_named("mgr"))
    job = policy_job(folder, algorithm=small("ddpg"))._replace(device="gpu")
    undisturbed = job.run(None)
    assert all(np.isfinite(weights).all() for weights in undisturbed.weights.values())
    kept = job._replace(checkpoint=tmp_path / "seed-1.ckpt")

    def interrupt(*told):
        raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        kept.run(interrupt)
    resumed = kept.run(None)
    for name, weights in undisturbed.weights.items():
        np.testing.assert_allclose(resumed.weights[name], weights, rtol=1e-3, atol=1e-4)
