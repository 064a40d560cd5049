"""The choices of conf/trainer: what Lightning is told changes how a model is trained, and not what it learns."""

import mlflow
import numpy as np
import pytest
import torch
import yaml

from swarmtwin.dynamics.model_config import config_class
from swarmtwin.dynamics.training import train
from swarmtwin.errors import UserError
from swarmtwin.learning.trainer_settings import LiveCurves, TrainerSettings
from swarmtwin.tracking.runs import tracked_run
from swarmtwin.tracking.store import store_uri
from toy import CONF, recipe, toy_transitions

FILES = sorted((CONF / "trainer").glob("*.yaml"))
NOISE = (1.0, 1.0, 0.03)


@pytest.fixture(scope="module")
def transitions(robots):
    return toy_transitions(robots["mgr"], 1200, noise=NOISE)


def trained(transitions, checkpoints=None, report=None, curves=None, steps=40, **settings):
    """An MLP trained for a few epochs, one seed."""
    config = config_class("mlp")(steps=steps)
    trainer = TrainerSettings(**settings)
    chosen = recipe(batch_size=120)
    return train(transitions, config, chosen, [1], checkpoints, report, device="cpu", trainer=trainer, curves=curves)


@pytest.mark.parametrize("file", FILES, ids=lambda file: file.stem)
def test_every_choice_is_one_that_lightning_is_told(file):
    settings = TrainerSettings.parse(yaml.safe_load(file.read_text()), file.name)
    assert settings.name == file.stem
    if file.stem == "default":
        assert settings == TrainerSettings()


def test_several_processes_want_a_strategy():
    with pytest.raises(UserError, match="trainer=ddp_cpu"):
        TrainerSettings.parse({"processes": 2}, "trainer")


def test_two_processes_learn_what_one_learns(transitions, tmp_path):
    """The mean of the gradients over two halves of a batch is that over the batch: equal up to rounding."""
    alone = trained(transitions)
    together = trained(transitions, tmp_path, processes=2, strategy="ddp_fork")
    np.testing.assert_allclose(np.array(together.best.history), np.array(alone.best.history), rtol=2e-3)
    for name, weights in alone.best.weights.items():
        np.testing.assert_allclose(together.best.weights[name], weights, rtol=0, atol=2e-3)


def test_a_training_that_gains_nothing_ends_early(transitions):
    unlearnable = transitions.displacement.copy()
    unlearnable[:] = np.random.default_rng(0).permutation(unlearnable)
    fruitless = type(transitions)(**{**vars(transitions), "displacement": unlearnable})
    patient = trained(fruitless, patience_epochs=3, steps=400)
    assert patient.best.best + 3 == len(patient.best.history) < 400 // 6
    to_the_end = trained(transitions, steps=60)
    assert len(to_the_end.best.history) == len(trained(transitions, steps=60, patience_epochs=1000).best.history)


def test_errors_arrive_in_the_run_while_it_learns(transitions, workplace):
    """After each epoch those of the epochs before are there; the run goes on, and ends with its block."""
    client, seen = None, []

    def look(seed, epoch, errors):
        arrived = client.get_metric_history(run_id, "seed_1-validation_position_mm")
        seen.append((epoch, [point.value for point in arrived], client.get_run(run_id).info.status))

    with tracked_run("dynamics", "live", {}) as tracked:
        client, run_id = mlflow.MlflowClient(store_uri()), tracked.run_id
        outcome = trained(transitions, report=look, curves=LiveCurves(run_id, store_uri()), steps=20)
        assert client.get_run(run_id).info.status == "RUNNING"
    errors = [epoch.validation_position_mm for epoch in outcome.best.history]
    assert seen == [(epoch, errors[:epoch], "RUNNING") for epoch in range(1, len(errors) + 1)]
    assert client.get_run(run_id).info.status == "FINISHED"
    assert {"seed_1-learning_rate", "seed_1-train_position_mm"} <= client.get_run(run_id).data.metrics.keys()


def test_a_run_shows_how_busy_the_machine_is(workplace, monkeypatch):
    monkeypatch.setenv("MLFLOW_SYSTEM_METRICS_SAMPLING_INTERVAL", "0.1")
    monkeypatch.setenv("MLFLOW_SYSTEM_METRICS_SAMPLES_BEFORE_LOGGING", "1")
    with tracked_run("dynamics", "busy", {}, system_metrics=True) as tracked:
        torch.ones(300, 300) @ torch.ones(300, 300)
        import time

        time.sleep(0.5)
    metrics = mlflow.MlflowClient(store_uri()).get_run(tracked.run_id).data.metrics
    assert 0 < metrics["system/system_memory_usage_percentage"] <= 100


def test_16_bits_learn_nearly_the_same(transitions):
    single, half = (trained(transitions, precision=precision) for precision in ("32-true", "bf16-mixed"))
    errors = [one.best.history[-1].validation_position_mm for one in (single, half)]
    assert errors[0] != errors[1]
    assert errors[1] == pytest.approx(errors[0], rel=0.05)
    assert all(weights.dtype == np.float32 for weights in half.best.weights.values() if weights.dtype.kind == "f")


def test_checkpoints_every_few_epochs_go_on_to_the_same_numbers(transitions, tmp_path):
    """Interrupted in epoch 6, with a checkpoint after every fourth: epochs 5 and 6 are learned again."""

    def interrupt(seed, epoch, errors):
        if epoch == 6:
            raise KeyboardInterrupt

    undisturbed = trained(transitions)
    with pytest.raises(KeyboardInterrupt):
        trained(transitions, tmp_path, interrupt, checkpoint_epochs=4)
    again = []
    resumed = trained(transitions, tmp_path, lambda seed, epoch, _: again.append(epoch), checkpoint_epochs=4)
    assert again[0] == 5
    assert resumed.best.history == undisturbed.best.history
    assert all(np.array_equal(resumed.best.weights[name], values) for name, values in undisturbed.best.weights.items())


def test_lightnings_own_bar_is_shown_where_it_is_asked_for(transitions, capsys):
    trained(transitions, steps=20)
    assert "Epoch" not in capsys.readouterr().out
    trained(transitions, steps=20, progress_bar="rich")
    assert "Epoch" in capsys.readouterr().out
