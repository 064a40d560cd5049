"""Trains one seed of a model: the same seed gives the same numbers, interrupted or not."""

import hashlib
import json
from pathlib import Path
from typing import NamedTuple

import numpy as np
import torch

from swarmtwin.dynamics.base import Dynamics
from swarmtwin.dynamics.batches import OrderedBatches, ShuffledBatches
from swarmtwin.dynamics.liveness import dead_outputs
from swarmtwin.dynamics.model_config import ModelConfig
from swarmtwin.dynamics.progress import Epoch, EpochReport, Progress
from swarmtwin.dynamics.recipe import Recipe
from swarmtwin.dynamics.training_data import TrainingData
from swarmtwin.trainer import one_thread, run_trainer

# With fewer steps a live network can still be as good as constant.
STEPS_TO_JUDGE = 100


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
            run_trainer(dynamics, progress, batches, OrderedBatches(*data.validation), epochs=left)
        dynamics.load_state_dict(progress.best_weights or dynamics.state_dict())
        weights = {name: tensor.numpy().copy() for name, tensor in dynamics.state_dict().items()}
        dead = _why_dead(dynamics.eval(), progress, data)
    return SeedResult(seed, tuple(progress.history), weights, progress.best_epoch, progress.best_loss, dead)


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
