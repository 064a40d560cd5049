"""Trains several seeds of a dynamics model and keeps the best live one."""

import hashlib
import json
import logging
import math
import time
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import NamedTuple

import numpy as np
import torch

from swarmtwin.dynamics.evaluation import ErrorFigure, predict
from swarmtwin.dynamics.model_config import FittedModelConfig, ModelConfig
from swarmtwin.dynamics.motion_noise import MotionNoise
from swarmtwin.dynamics.predictor import NetworkDynamics
from swarmtwin.dynamics.spread import calibrate_spread
from swarmtwin.dynamics.training_module import Epoch, EpochHistory, EpochReport, TrainingModule
from swarmtwin.errors import UserError
from swarmtwin.learning.batches import OrderedBatches, ShuffledBatches, TensorSplits, tensor_splits
from swarmtwin.learning.dead_outputs import dead_outputs
from swarmtwin.learning.device import Device, reproducible, torch_device
from swarmtwin.learning.ensemble import bootstrap_counts
from swarmtwin.learning.parallel import cores, run_side_by_side
from swarmtwin.learning.recipe import Recipe
from swarmtwin.learning.trainer import run_trainer
from swarmtwin.learning.trainer_settings import LiveCurves, TrainerSettings
from swarmtwin.transitions import SPLITS
from swarmtwin.transitions.source import TransitionSource

log = logging.getLogger(__name__)


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


class TrainingJob(NamedTuple):
    """One seed to train, in this process or another.

    Attributes:
        transitions: measured or synthetic transitions with their splits, in memory or in a file.
        config: which model.
        recipe: how to train it; its learning rate and epochs are known.
        seed: of initial weights, order and dropout.
        checkpoint: a file, written after each epoch, from which an interrupted training is continued to the same
            numbers bit for bit; None: neither written nor read.
        device: where to train.
        trainer: how Lightning trains, but for the device.
        curves: the run that the errors of each epoch are sent to, named after the seed; None: none.
    """

    transitions: TransitionSource
    config: ModelConfig
    recipe: Recipe
    seed: int
    checkpoint: Path | None = None
    device: Device = "auto"
    trainer: TrainerSettings = TrainerSettings()
    curves: LiveCurves | None = None

    @property
    def epochs(self) -> int:
        """How many passes over the training data there are."""
        assert self.recipe.epochs is not None
        return self.recipe.epochs

    def run(self, report: EpochReport | None) -> SeedResult:
        """Train, on one thread.

        Raises:
            UserError: too little data, values that are not finite, or no GPU where one is asked for.
        """
        data = self._data()
        with reproducible(self.seed, self.device):
            if isinstance(self.config, FittedModelConfig):
                return self._fitted(self.config, data, report)
            module, batches = self._prepared(data)
            checkpoint, every = self._checkpoint(), self.trainer.checkpoint_epochs
            told = report if self.trainer.processes == 1 else None  # who is told is in this process
            history = EpochHistory(self.seed, self._identity(data), batches, checkpoint, told, every)
            resume_from = history.read_checkpoint()
            if len(history.errors) < self.epochs and not history.diverged:
                validation = OrderedBatches(*data.to(torch_device(self.device)).validation)
                run_trainer(
                    module,
                    history,
                    batches,
                    validation,
                    epochs=self.epochs,
                    device=self.device,
                    resume_from=resume_from,
                    settings=self.trainer,
                    curves=self.curves if self.trainer.processes == 1 else None,  # no database is used across a fork
                    prefix=f"seed_{self.seed}",
                )
                if self.trainer.processes > 1:  # what the others have seen stands in the file alone
                    history.read_checkpoint()
            dynamics = module.dynamics.cpu()
            dynamics.load_state_dict(history.best_weights or dynamics.state_dict())
            dead = _why_dead(dynamics.eval(), history, len(batches), data)
        errors = tuple(history.errors)
        return SeedResult(self.seed, errors, _arrays(dynamics), history.best_epoch, history.best_loss, dead)

    def _fitted(self, config: FittedModelConfig, data: TensorSplits, report: EpochReport | None) -> SeedResult:
        """Fit in one go: the history has one entry, and there is nothing to continue."""
        dynamics = NetworkDynamics(data.robot, config)
        dynamics.learn_scaling(*data.train, data.arena_mm)
        train, validation = (
            (dynamics.encoding(situation), dynamics.output_scaling(displacement))
            for situation, displacement in (data.train, data.validation)
        )
        config.fit(dynamics.network, train, validation, self.seed)
        fitted, unseen = (
            ErrorFigure.between(dynamics.eval().predict(situation).numpy().astype(float), displacement.numpy())
            for situation, displacement in (data.train, data.validation)
        )
        epoch = Epoch(fitted.position_mm, fitted.orientation_deg, unseen.position_mm, unseen.orientation_deg)
        if report:
            report(self.seed, self.epochs, epoch)
        loss = unseen.position_mm + self.recipe.heading_weight * math.radians(unseen.orientation_deg)
        return SeedResult(self.seed, (epoch,), _arrays(dynamics), 1, loss, _constant_outputs(dynamics, data))

    def expected_s(self) -> float:
        """Estimate how long `run` takes, from the second of two steps; 0 for what is fitted in one go."""
        if isinstance(self.config, FittedModelConfig):
            return 0.0
        data = self._data()
        with reproducible(self.seed, self.device):
            module, batches = self._prepared(data)
            module.to(torch_device(self.device))
            batch = next(iter(batches))
            for _ in range(2):
                start = time.perf_counter()
                position_mm, orientation_rad = module.errors(batch)
                (position_mm + orientation_rad).backward()
                step_s = time.perf_counter() - start
        return step_s * len(batches) * self.epochs

    def _checkpoint(self) -> Path | None:
        """Return the file for checkpoints; several processes need one, to leave there what came of them."""
        if self.checkpoint is None and self.trainer.processes > 1:
            raise UserError("several processes that train together need a folder for checkpoints: give checkpoints=")
        return self.checkpoint

    def _data(self) -> TensorSplits:
        return tensor_splits(self.transitions, self.config.inputs(self.transitions.robot))

    def _prepared(self, data: TensorSplits) -> tuple[TrainingModule, ShuffledBatches]:
        dynamics = NetworkDynamics(data.robot, self.config)
        dynamics.learn_scaling(*data.train, data.arena_mm)
        on_device = data.to(torch_device(self.device))
        counts = None
        if dynamics.drawn_members:
            counts = self._counts(dynamics.drawn_members).to(torch_device(self.device))
        batches = ShuffledBatches(*on_device.train, self.recipe.batch_size, self.seed, counts)
        return TrainingModule(dynamics, self.recipe, self.epochs * len(batches)), batches

    def _counts(self, members: int) -> torch.Tensor:
        """Return (N, M) how often each transition to train on counts for each member of an ensemble."""
        train = SPLITS.index("train")
        learned = [
            (block["vehicle"][rows], block["run"][rows])
            for block in self.transitions.blocks(("vehicle", "run", "split"))
            for rows in [block["split"] == train]
        ]
        vehicle, run = (np.concatenate(parts) for parts in zip(*learned, strict=True))
        return torch.as_tensor(bootstrap_counts(vehicle, run, members, self.seed), dtype=torch.float32)

    def _identity(self, data: TensorSplits) -> str:
        parts = (self.config, self.recipe, data.robot, self.trainer)
        settings = [part.model_dump(mode="json") for part in parts]
        return hashlib.sha256(json.dumps([*settings, data.digest(), self.seed]).encode()).hexdigest()


def _arrays(dynamics: NetworkDynamics) -> dict[str, np.ndarray]:
    return {name: tensor.numpy().copy() for name, tensor in dynamics.state_dict().items()}


def _why_dead(dynamics: NetworkDynamics, history: EpochHistory, steps_an_epoch: int, data: TensorSplits) -> str | None:
    if history.diverged:
        return f"the errors were no longer finite in epoch {len(history.errors)}"
    if len(history.errors) * steps_an_epoch < 100:  # a live network can still be as good as constant
        return None
    return _constant_outputs(dynamics, data)


def _constant_outputs(dynamics: NetworkDynamics, data: TensorSplits) -> str | None:
    situation, displacement = data.validation
    with torch.inference_mode():
        inputs = dynamics.encoding(situation)
    dead = dead_outputs(dynamics.predict(situation).numpy(), displacement.numpy(), inputs.numpy())
    return f"constant output: {', '.join(dead)}" if dead else None


def train_seeds(
    jobs: Sequence[TrainingJob], report: EpochReport | None, processes: int | None, most_side_by_side: int = 2_000_000
) -> list[SeedResult]:
    """Train all jobs, `processes` at a time; None: as many as there are cores, or one where that is quicker.

    One as well where there are more than `most_side_by_side` transitions to learn from: each process has its own.
    """
    at_a_time = min(len(jobs), processes or cores())
    if processes is None and at_a_time > 1:
        if max(job.transitions.count("train") for job in jobs) > most_side_by_side:
            at_a_time = 1
        elif (len(jobs) - math.ceil(len(jobs) / at_a_time)) * jobs[0].expected_s() < 7:
            at_a_time = 1  # 7 s are what new processes take to import everything; measured on two cores
    return run_side_by_side(jobs, report, at_a_time)


@dataclass(frozen=True)
class Trained:
    """A trained model and what came of each seed.

    Attributes:
        dynamics: the live seed with the lowest validation loss, in eval mode.
        seed: its seed.
        recipe: the recipe with all its values known.
        results: one for each seed, in the order asked for.
    """

    dynamics: NetworkDynamics
    seed: int
    recipe: Recipe
    results: tuple[SeedResult, ...]

    @property
    def best(self) -> SeedResult:
        """The chosen seed's result."""
        return next(result for result in self.results if result.seed == self.seed)

    @property
    def dead_seeds(self) -> dict[int, str]:
        """The seeds that cannot be used, with the reason."""
        return {result.seed: result.dead for result in self.results if result.dead}


def train(
    transitions: TransitionSource,
    config: ModelConfig,
    recipe: Recipe,
    seeds: Sequence[int],
    checkpoints: Path | None = None,
    report: EpochReport | None = None,
    processes: int | None = None,
    reserve: int = 0,
    device: Device = "auto",
    trainer: TrainerSettings | None = None,
    curves: LiveCurves | None = None,
) -> Trained:
    """Train each seed on the training split; the best live one on the validation split is the model.

    Dead seeds are replaced by those that follow the last one, at most `reserve` of them, and stay in the results.

    Args:
        transitions: measured or synthetic transitions with their splits, in memory or in a file.
        config: which model.
        recipe: how to train it.
        seeds: one training each.
        checkpoints: a folder from which interrupted seeds continue, written after each epoch.
        report: called after each epoch of each seed.
        processes: seeds trained at a time; by default as many as there are cores, or one where that is quicker.
        reserve: how many further seeds may be tried in place of dead ones.
        device: where to train.
        trainer: how Lightning trains; by default as `conf/trainer/default.yaml` says.
        curves: the run that the errors of each seed's epochs are sent to while it learns; None: none.

    Raises:
        UserError: too little data, values that are not finite, every seed is dead, or no GPU where one is asked for.
    """
    recipe = recipe.completed(config.learning_rate, config.steps, transitions.count("train"))
    trainer = trainer or TrainerSettings()
    if trainer.processes > 1:  # that share one seed's training
        processes = 1
    if checkpoints:
        checkpoints.mkdir(parents=True, exist_ok=True)
    results: list[SeedResult] = []
    waiting, spare = list(seeds), list(range(seeds[-1] + 1, seeds[-1] + 1 + reserve))
    while waiting:
        files = [checkpoints / f"seed-{seed}.ckpt" if checkpoints else None for seed in waiting]
        jobs = [
            TrainingJob(transitions, config, recipe, seed, file, device, trainer, curves)
            for seed, file in zip(waiting, files, strict=True)
        ]
        tried = train_seeds(jobs, report, processes)
        results += tried
        dead = [result for result in tried if result.dead]
        for result in dead:
            log.warning("%s, seed %d is dead: %s", config.name, result.seed, result.dead)
        waiting, spare = spare[: len(dead)], spare[len(dead) :]
    best = _best_live(config, results)
    weights = {name: torch.from_numpy(values) for name, values in best.weights.items()}
    dynamics = NetworkDynamics.with_weights(transitions.robot, config, weights)
    unseen = transitions.part("validation")
    dynamics.motion_noise = MotionNoise.estimate(unseen, predict(dynamics, unseen))
    if dynamics.drawn_members:
        calibrate_spread(dynamics, unseen)
    return Trained(dynamics, best.seed, recipe, tuple(results))


def _best_live(config: ModelConfig, results: Sequence[SeedResult]) -> SeedResult:
    live = [result for result in results if not result.dead]
    if not live:
        reasons = "; ".join(f"seed {result.seed}: {result.dead}" for result in results)
        raise UserError(
            f"{config.name}: every seed is dead ({reasons}): try other seeds, a lower learning rate, or another model"
        )
    return min(live, key=lambda result: result.validation_loss)
