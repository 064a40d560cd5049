"""Trains one seed of a model: the same seed gives the same numbers, interrupted or not."""

import hashlib
import json
import logging
import signal
import warnings
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import NamedTuple

import lightning
import numpy as np
import torch
from lightning.pytorch.plugins.environments import LightningEnvironment

from swarmtwin.dynamics.base import Dynamics
from swarmtwin.dynamics.batches import OrderedBatches, ShuffledBatches
from swarmtwin.dynamics.liveness import dead_outputs
from swarmtwin.dynamics.model_config import ModelConfig
from swarmtwin.dynamics.progress import Epoch, EpochReport, Progress
from swarmtwin.dynamics.recipe import Recipe
from swarmtwin.dynamics.training_data import TrainingData

# With fewer steps a live network can still be as good as constant.
STEPS_TO_JUDGE = 100

logging.getLogger("lightning.pytorch").setLevel(logging.WARNING)


class SeedResult(NamedTuple):
    """What came of one seed.

    Attributes:
        seed: the seed.
        history: the errors after each epoch.
        weights: those with the lowest validation loss, by name.
        best: the number of their epoch, from 1.
        validation_loss: their loss on the validation data.
        dead: why the seed cannot be used; None for a live one.
    """

    seed: int
    history: tuple[Epoch, ...]
    weights: dict[str, np.ndarray]
    best: int
    validation_loss: float
    dead: str | None


def fit_seed(
    config: ModelConfig,
    recipe: Recipe,
    data: TrainingData,
    seed: int,
    checkpoint: Path | None = None,
    report: EpochReport | None = None,
) -> SeedResult:
    """Train `config` by a recipe whose learning rate and epochs are known, on one thread.

    With a checkpoint file, which is written after each epoch, an interrupted training is continued, to the same
    numbers bit for bit.
    """
    assert recipe.epochs is not None
    with one_thread(), torch.random.fork_rng(devices=[]):
        torch.manual_seed(seed)
        dynamics = Dynamics(data.robot, config)
        dynamics.learn_scaling(*data.train)
        batches = ShuffledBatches(*data.train, size=recipe.batch_size, seed=seed)
        dynamics.recipe, dynamics.training_steps = recipe, recipe.epochs * len(batches)
        identity = _identity(config, recipe, data, seed)
        progress = Progress(seed, identity, batches, recipe.heading_weight, checkpoint, report)
        if (left := recipe.epochs - len(progress.history)) and not progress.diverged:
            _run_trainer(dynamics, progress, batches, OrderedBatches(*data.validation), left)
        dynamics.load_state_dict(progress.best_weights or dynamics.state_dict())
        weights = {name: tensor.numpy().copy() for name, tensor in dynamics.state_dict().items()}
        dead = _why_dead(dynamics.eval(), progress, data)
    return SeedResult(seed, tuple(progress.history), weights, progress.best_epoch, progress.best_loss, dead)


def _run_trainer(
    dynamics: Dynamics, progress: Progress, batches: ShuffledBatches, validation: OrderedBatches, epochs: int
) -> None:
    trainer = lightning.Trainer(
        accelerator="cpu",
        devices=1,
        max_epochs=epochs,
        callbacks=[progress],
        plugins=[LightningEnvironment()],
        logger=False,
        enable_checkpointing=False,
        enable_progress_bar=False,
        enable_model_summary=False,
        num_sanity_val_steps=0,
    )
    interrupt_handler = signal.getsignal(signal.SIGINT)
    try:
        with warnings.catch_warnings():
            warnings.filterwarnings("ignore", module=r"lightning\.")
            trainer.fit(dynamics, train_dataloaders=batches, val_dataloaders=validation)
    except SystemExit:  # what Lightning makes of Ctrl-C and SIGTERM
        signal.signal(signal.SIGINT, interrupt_handler)
        raise KeyboardInterrupt from None


def _why_dead(dynamics: Dynamics, progress: Progress, data: TrainingData) -> str | None:
    if progress.diverged:
        return f"the errors were no longer finite in epoch {len(progress.history)}"
    if len(progress.history) * len(progress.batches) < STEPS_TO_JUDGE:
        return None
    situation, displacement = data.validation
    with torch.inference_mode():
        predicted, inputs = dynamics(situation), dynamics.encoding(situation)
    dead = dead_outputs(predicted.numpy(), displacement.numpy(), inputs.numpy())
    return f"constant output: {', '.join(dead)}" if dead else None


def _identity(config: ModelConfig, recipe: Recipe, data: TrainingData, seed: int) -> str:
    settings = [config.model_dump(mode="json"), recipe.model_dump(mode="json"), data.robot.model_dump(mode="json")]
    return hashlib.sha256(json.dumps([*settings, data.digest(), seed]).encode()).hexdigest()


@contextmanager
def one_thread() -> Iterator[None]:
    """Let torch compute on one thread: as quick on nets this small, and the same numbers every time."""
    threads = torch.get_num_threads()
    torch.set_num_threads(1)
    try:
        yield
    finally:
        torch.set_num_threads(threads)
