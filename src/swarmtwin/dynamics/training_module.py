"""What Lightning needs to train a dynamics model: loss, step and optimiser, and what is kept of each epoch."""

import logging
import math
from collections.abc import Callable
from pathlib import Path
from typing import Any, NamedTuple, cast

import lightning
import torch
from torch import Tensor
from torch.optim.lr_scheduler import ReduceLROnPlateau

from swarmtwin.dynamics.mean_variance import MeanVarianceEnsemble
from swarmtwin.dynamics.predictor import NetworkDynamics
from swarmtwin.files import whole_file
from swarmtwin.geometry import wrap_angle
from swarmtwin.learning.batches import Batch, CountedBatch, ShuffledBatches, epoch_seed
from swarmtwin.learning.recipe import Recipe
from swarmtwin.learning.trainer import VALIDATION_LOSS

log = logging.getLogger(__name__)


class TrainingModule(lightning.LightningModule):
    """Trains a network by a recipe.

    Attributes:
        dynamics: the network that is trained.
        recipe: how; its learning rate is known.
        steps: how many optimiser steps the whole training takes.
    """

    def __init__(self, dynamics: NetworkDynamics, recipe: Recipe, steps: int) -> None:
        super().__init__()
        self.automatic_optimization = False
        self.dynamics = dynamics
        self.recipe = recipe
        self.steps = steps

    def errors(self, batch: Batch | CountedBatch) -> tuple[Tensor, Tensor]:
        """Return the mean position error in mm and the mean orientation error in rad over a batch, with gradients."""
        situation, displacement, *_ = batch
        residual = self.dynamics(situation) - displacement
        position_mm = torch.linalg.vector_norm(residual[:, :2], dim=1).mean()
        return position_mm, wrap_angle(residual[:, 2]).abs().mean()

    def loss(self, batch: Batch | CountedBatch) -> tuple[Tensor, Tensor]:
        """Return the loss with gradients, and the errors: position in mm and orientation in rad, (2,)."""
        network = self.dynamics.network
        if isinstance(network, MeanVarianceEnsemble):
            situation, displacement, counts = cast(CountedBatch, batch)
            scaled = self.dynamics.output_scaling(displacement)
            with torch.no_grad():
                errors = torch.stack(self.errors(batch))
            return network.loss(self.dynamics.encoding(situation), scaled, counts), errors
        position_mm, orientation_rad = self.errors(batch)
        loss = position_mm + self.recipe.heading_weight * orientation_rad
        return loss, torch.stack([position_mm, orientation_rad]).detach()

    def training_step(self, batch: Batch | CountedBatch, batch_index: int) -> dict[str, Tensor]:
        """Take one step of the recipe's optimiser and schedule."""
        optimiser = cast(Any, self.optimizers(use_pl_optimizer=False))
        loss, errors = self.loss(self._own_share(batch))
        optimiser.zero_grad()
        self.manual_backward(loss)
        optimiser.step()
        scheduler = cast(Any, self.lr_schedulers())
        if not isinstance(scheduler, ReduceLROnPlateau):
            scheduler.step()
        return {"loss": loss.detach(), "errors": errors}

    def _own_share(self, batch: Batch | CountedBatch) -> Batch | CountedBatch:
        """Return the rows of a batch that are this process's, where several train together."""
        together, own = self.trainer.world_size, self.trainer.global_rank
        if together == 1:
            return batch
        return cast("Batch | CountedBatch", tuple(part[own::together] for part in batch))

    def validation_step(self, batch: Batch, batch_index: int) -> dict[str, Tensor]:
        """Return the batch's mean errors, position in mm and orientation in rad."""
        return {"errors": torch.stack(self.errors(batch))}

    def configure_optimizers(self) -> Any:
        """Build what the recipe says."""
        optimiser = self.recipe.optimiser(self.dynamics.parameters())
        return {"optimizer": optimiser, "lr_scheduler": self.recipe.scheduler(optimiser, self.steps)}


class Epoch(NamedTuple):
    """Mean errors of one epoch: over its training batches while the weights changed, and over the validation data."""

    train_position_mm: float
    train_orientation_deg: float
    validation_position_mm: float
    validation_orientation_deg: float

    def __str__(self) -> str:
        return f"{self.validation_position_mm:.2f} mm  {self.validation_orientation_deg:.2f}°"

    @property
    def finite(self) -> bool:
        """Whether no error is NaN or infinite."""
        return all(math.isfinite(error) for error in self)


EpochReport = Callable[[int, int, Epoch], None]
"""Called after each epoch with the seed, the epoch's number from 1, and its errors."""


class EpochHistory(lightning.Callback):
    """Follows one seed's training: its errors, its best weights, and a checkpoint file after each epoch.

    Attributes:
        errors: one entry an epoch.
        best_weights: the weights with the lowest validation loss so far, by name, on the CPU.
        best_loss: that loss.
        best_epoch: the number of their epoch, from 1; 0 before the first.
    """

    def __init__(
        self,
        seed: int,
        identity: str,
        batches: ShuffledBatches,
        checkpoint: Path | None = None,
        report: EpochReport | None = None,
        checkpoint_epochs: int = 1,
    ) -> None:
        """Follow a training.

        Args:
            seed: of the training.
            identity: tells apart trainings that may not continue each other.
            batches: told which epoch it is.
            checkpoint: the file from which an interrupted training continues.
            report: called after each epoch.
            checkpoint_epochs: so many epochs lie between two checkpoints; there is always one after the last.
        """
        self.seed = seed
        self.identity = identity
        self.batches = batches
        self.checkpoint = checkpoint
        self.report = report
        self.checkpoint_epochs = checkpoint_epochs
        self.errors: list[Epoch] = []
        self.best_loss = math.inf
        self.best_epoch = 0
        self.best_weights: dict[str, Tensor] = {}
        self._train = torch.empty(0, 2)
        self._steps = 0
        self._validation: list[tuple[Tensor, int]] = []

    @property
    def diverged(self) -> bool:
        """Whether the last epoch's errors were NaN or infinite."""
        return bool(self.errors) and not self.errors[-1].finite

    def read_checkpoint(self) -> Path | None:
        """Take over the history of the checkpoint and return its file; None if there is none that can be used.

        One that is damaged or of another training is told of.
        """
        if self.checkpoint is None or not self.checkpoint.exists():
            return None
        try:
            state = torch.load(self.checkpoint, weights_only=True)["callbacks"][self.state_key]
        except Exception as error:  # torch.load raises many kinds for a damaged file
            log.warning("seed %d starts anew: checkpoint %s is damaged (%s)", self.seed, self.checkpoint, error)
            return None
        if state["identity"] != self.identity:
            log.warning("seed %d starts anew: checkpoint %s is of another training", self.seed, self.checkpoint)
            return None
        self.load_state_dict(state)
        return self.checkpoint

    def state_dict(self) -> dict[str, Any]:
        """Return what a checkpoint keeps of the history."""
        return {
            "identity": self.identity,
            "errors": [tuple(epoch) for epoch in self.errors],
            "best_loss": self.best_loss,
            "best_epoch": self.best_epoch,
            "best_weights": self.best_weights,
        }

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Continue a history."""
        self.errors = [Epoch(*errors) for errors in state["errors"]]
        self.best_loss, self.best_epoch = state["best_loss"], state["best_epoch"]
        self.best_weights = state["best_weights"]

    def on_train_epoch_start(self, trainer: lightning.Trainer, module: lightning.LightningModule) -> None:
        """Make order and dropout of the epoch depend on seed and epoch alone, so that a continued training is equal."""
        self.batches.epoch = len(self.errors)
        torch.manual_seed(epoch_seed(self.seed, len(self.errors)))
        self._train = torch.empty(len(self.batches), 2, device=module.device)
        self._steps, self._validation = 0, []

    def on_train_batch_end(
        self, trainer: lightning.Trainer, module: lightning.LightningModule, outputs: Any, batch: Batch, batch_idx: int
    ) -> None:
        """Note the batch's errors."""
        self._train[self._steps] = outputs["errors"]
        self._steps += 1

    def on_validation_batch_end(
        self,
        trainer: lightning.Trainer,
        module: lightning.LightningModule,
        outputs: Any,
        batch: Batch,
        batch_idx: int,
        dataloader_idx: int = 0,
    ) -> None:
        """Note the batch's errors and size."""
        self._validation.append((outputs["errors"], len(batch[0])))

    def on_train_epoch_end(self, trainer: lightning.Trainer, module: lightning.LightningModule) -> None:
        """Close the epoch: errors, schedule, best weights, checkpoint, report."""
        assert isinstance(module, TrainingModule)
        epoch = self._close_epoch(trainer)
        self.errors.append(epoch)
        orientation_rad = math.radians(epoch.validation_orientation_deg)
        loss = epoch.validation_position_mm + module.recipe.heading_weight * orientation_rad
        scheduler = trainer.lr_scheduler_configs[0].scheduler
        if isinstance(scheduler, ReduceLROnPlateau):
            scheduler.step(loss)
        if loss < self.best_loss:
            self.best_loss, self.best_epoch = loss, len(self.errors)
            weights = module.dynamics.state_dict()
            self.best_weights = {name: tensor.cpu().clone() for name, tensor in weights.items()}
        if self.diverged:
            trainer.should_stop = True
        module.log(VALIDATION_LOSS, loss, logger=False)
        if trainer.logger:
            rate = scheduler.optimizer.param_groups[0]["lr"]
            trainer.logger.log_metrics({**epoch._asdict(), "learning_rate": rate}, step=len(self.errors))
        if self.checkpoint is not None and len(self.errors) % self.checkpoint_epochs == 0:
            self._save_checkpoint(trainer, self.checkpoint)
        if self.report:
            self.report(self.seed, len(self.errors), epoch)

    def on_train_end(self, trainer: lightning.Trainer, module: lightning.LightningModule) -> None:
        """Keep the end, where it lies between two checkpoints."""
        if self.checkpoint is not None and len(self.errors) % self.checkpoint_epochs:
            self._save_checkpoint(trainer, self.checkpoint)

    def _save_checkpoint(self, trainer: lightning.Trainer, file: Path) -> None:
        """Write a checkpoint, whole or not at all; of several processes the first writes, and all wait."""
        if trainer.is_global_zero:
            with whole_file(file) as aside:
                trainer.save_checkpoint(aside)
        else:
            trainer.save_checkpoint(file)

    def _close_epoch(self, trainer: lightning.Trainer) -> Epoch:
        train = self._train[: self._steps].mean(dim=0)
        if trainer.world_size > 1:  # each process has seen its share of each batch
            train = cast(Tensor, trainer.strategy.reduce(train, reduce_op="mean"))
        train_mm, train_rad = train.tolist()
        count = sum(size for _, size in self._validation)
        validation_mm, validation_rad = (
            torch.stack([errors * (size / count) for errors, size in self._validation]).sum(dim=0).tolist()
        )
        return Epoch(train_mm, math.degrees(train_rad), validation_mm, math.degrees(validation_rad))
