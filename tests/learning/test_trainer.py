"""The choices of conf/trainer: what Lightning is told changes how a model is trained, and not what it learns."""

import inspect
import time
from types import SimpleNamespace

import lightning
import mlflow
import numpy as np
import pytest
import torch
import yaml

from swarmtwin.dynamics.model_config import config_class
from swarmtwin.dynamics.training import train
from swarmtwin.errors import UserError
from swarmtwin.learning.trainer import run_trainer
from swarmtwin.learning.trainer_settings import SET_ELSEWHERE, LiveCurves, TrainerSettings
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


def test_a_run_shows_how_busy_the_machine_is_and_says_nothing_of_it(workplace, monkeypatch, capfd):
    monkeypatch.setenv("MLFLOW_SYSTEM_METRICS_SAMPLING_INTERVAL", "0.1")
    with tracked_run("dynamics", "busy", {}, system_metrics=TrainerSettings().system_metrics) as tracked:
        torch.ones(300, 300) @ torch.ones(300, 300)
        time.sleep(0.5)
    shown = capfd.readouterr()
    assert "metrics" not in shown.out + shown.err
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


def test_what_a_trainer_is_told_is_not_handed_over_as_an_option_as_well(transitions, monkeypatch):
    told = {}

    class Trainer(lightning.Trainer):
        def __init__(self, **options):
            told.update(options)
            super().__init__(**options)

    monkeypatch.setattr("swarmtwin.learning.trainer.lightning", SimpleNamespace(Trainer=Trainer))
    trained(transitions, steps=10, options={"detect_anomaly": True, "max_time": {"hours": 1}})
    assert (told.pop("detect_anomaly"), told.pop("max_time")) == (True, {"hours": 1})
    assert told.keys() <= SET_ELSEWHERE.keys()


def test_every_option_that_is_set_elsewhere_is_one_of_lightnings():
    assert inspect.signature(lightning.Trainer).parameters.keys() >= SET_ELSEWHERE.keys()


@pytest.mark.parametrize(
    ("options", "message"),
    [
        (
            {"gradient_clip": 1},
            "trainer: field 'options': Value error, lightning.Trainer has no option 'gradient_clip': did you mean "
            "'gradient_clip_val'? known: benchmark, ",
        ),
        (
            {"max_epochs": 3},
            "trainer: field 'options': Value error, 'max_epochs' is set elsewhere: recipe.epochs=... or",
        ),
        (
            {"precision": 16},
            "trainer: field 'options': Value error, 'precision' is set elsewhere: write trainer.precision",
        ),
        (
            {"gradient_clip_val": "much"},
            "trainer.options: Lightning refuses gradient_clip_val=much: `gradient_clip_val`",
        ),
        ({"profiler": "none"}, "trainer.options: Lightning refuses profiler=none: When passing string value"),
        ({"limit_train_batches": 0.01}, "trainer.options: Lightning refuses limit_train_batches=0.01: You requested"),
        ({"max_time": 5}, "trainer.options: Lightning refuses max_time=5: "),
        (
            {"limit_train_batches": 0},
            "trainer.options: nothing is learned with limit_train_batches=0: let it take a step",
        ),
    ],
)
def test_an_option_that_lightning_does_not_take_is_one_line(transitions, options, message):
    def attempt():
        settings = TrainerSettings.parse({"options": options}, "trainer")
        trained(transitions, steps=10, options=settings.options)

    with pytest.raises(UserError) as refused:
        attempt()
    assert str(refused.value).startswith(message)
    assert "\n" not in str(refused.value)


class TwoPlayers(lightning.LightningModule):
    """Two weights of two numbers, each with its own optimiser, that step by their gradients: (3, 4) and (30, 40)."""

    def __init__(self):
        super().__init__()
        self.automatic_optimization = False
        self.weights = torch.nn.ParameterList([torch.zeros(2), torch.zeros(2)])

    def configure_optimizers(self):
        return [torch.optim.SGD([weights], lr=1.0) for weights in self.weights]

    def training_step(self, batch, batch_index):
        for weights, optimiser, size in zip(
            self.weights, self.optimizers(use_pl_optimizer=False), (1.0, 10.0), strict=True
        ):
            optimiser.zero_grad()
            (-size * torch.tensor([3.0, 4.0]) @ weights).backward()
            optimiser.step()
        return {}


@pytest.mark.parametrize(
    ("options", "steps"),
    [
        ({}, [[3, 4], [30, 40]]),
        ({"gradient_clip_val": 10}, [[3, 4], [6, 8]]),
        ({"gradient_clip_val": 0.5, "gradient_clip_algorithm": "norm"}, [[0.3, 0.4], [0.3, 0.4]]),
        ({"gradient_clip_val": 3.5, "gradient_clip_algorithm": "value"}, [[3, 3.5], [3.5, 3.5]]),
    ],
)
def test_the_gradients_of_each_optimiser_are_clipped(options, steps):
    module = TwoPlayers()
    settings = TrainerSettings(progress_bar="none", options=options)
    run_trainer(module, lightning.Callback(), range(1), device="cpu", settings=settings)
    np.testing.assert_allclose([weights.tolist() for weights in module.weights], steps, rtol=1e-5)


def test_clipping_changes_a_training_only_where_it_clips(transitions):
    plain, never, often = (
        trained(transitions, options=options).best.history
        for options in ({}, {"gradient_clip_val": 1e9}, {"gradient_clip_val": 0.1})
    )
    assert plain == never
    assert plain != often


def test_a_training_ends_when_its_time_is_over(transitions):
    assert len(trained(transitions, steps=60).best.history) == 10
    hours = trained(transitions, steps=60_000, options={"max_time": {"seconds": 1}})
    assert 1 <= len(hours.best.history) < 5000


def test_an_interrupted_training_goes_on_with_the_same_options_alone(transitions, tmp_path):
    """With those that it began with it ends as one that nothing disturbed; with others it starts anew."""

    def interrupt(seed, epoch, errors):
        if epoch == 4:
            raise KeyboardInterrupt

    options = {"gradient_clip_val": 0.1, "max_time": {"hours": 1}}
    undisturbed = trained(transitions, options=options)
    for others, begins_with in (({"gradient_clip_val": 0.2}, 1), (options, 5)):
        with pytest.raises(KeyboardInterrupt):
            trained(transitions, tmp_path, interrupt, options=options)
        again = []
        resumed = trained(transitions, tmp_path, lambda seed, epoch, _, a=again: a.append(epoch), options=others)
        assert again[0] == begins_with
    assert resumed.best.history == undisturbed.best.history


def test_a_profiler_tells_what_took_how_long(transitions, caplog):
    trained(transitions, steps=10)
    assert "Profiler Report" not in caplog.text
    trained(transitions, steps=10, options={"profiler": "simple"})
    assert "Profiler Report" in caplog.text
