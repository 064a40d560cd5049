"""What is kept while one seed trains: its history, its best weights, and a checkpoint from which it continues."""

import io
import logging
import math
from collections.abc import Callable
from pathlib import Path
from typing import Any, NamedTuple, cast

import lightning
import torch
from torch import Tensor
from torch.optim.lr_scheduler import ReduceLROnPlateau

from swarmtwin.dynamics.base import Batch
from swarmtwin.dynamics.batches import ShuffledBatches, epoch_seed
from swarmtwin.files import whole_file

log = logging.getLogger(__name__)


class Epoch(NamedTuple):
    """Mean errors of one epoch: over its training batches while the weights changed, and over the validation data."""

    train_position_mm: float
    train_orientation_deg: float
    validation_position_mm: float
    validation_orientation_deg: float

    @property
    def finite(self) -> bool:
        """Whether no error is NaN or infinite."""
        return all(math.isfinite(error) for error in self)


EpochReport = Callable[[int, int, Epoch], None]
"""Called after each epoch with the seed, the epoch's number from 1, and its errors."""


class Progress(lightning.Callback):
    """Follows one seed's training. Given a checkpoint file, it writes it after each epoch and continues from it.

    Attributes:
        history: one entry an epoch.
        best_weights: the weights with the lowest validation loss so far.
        best_loss: that loss.
        best_epoch: the number of their epoch, from 1; 0 before the first.
    """

    def __init__(
        self,
        seed: int,
        identity: str,
        batches: ShuffledBatches,
        heading_weight: float,
        checkpoint: Path | None,
        report: EpochReport | None,
    ) -> None:
        self.seed = seed
        self.identity = identity
        self.batches = batches
        self.heading_weight = heading_weight
        self.checkpoint = checkpoint
        self.report = report
        self.history: list[Epoch] = []
        self.best_loss = math.inf
        self.best_epoch = 0
        self.best_weights: dict[str, Tensor] = {}
        self._train: list[Tensor] = []
        self._validation: list[tuple[Tensor, int]] = []
        self._saved = self._read_checkpoint()
        if self._saved:
            self.history = [Epoch(*errors) for errors in self._saved["history"]]
            self.best_loss, self.best_epoch = self._saved["best_loss"], self._saved["best_epoch"]
            self.best_weights = self._saved["best_weights"]

    @property
    def diverged(self) -> bool:
        """Whether the last epoch's errors were NaN or infinite."""
        return bool(self.history) and not self.history[-1].finite

    def on_train_start(self, trainer: lightning.Trainer, dynamics: lightning.LightningModule) -> None:
        """Continue from the checkpoint, if there is one."""
        if not self._saved:
            return
        dynamics.load_state_dict(self._saved["weights"])
        trainer.optimizers[0].load_state_dict(self._saved["optimiser"])
        trainer.lr_scheduler_configs[0].scheduler.load_state_dict(self._saved["schedule"])

    def on_train_epoch_start(self, trainer: lightning.Trainer, dynamics: lightning.LightningModule) -> None:
        """Make order and dropout of the epoch depend on seed and epoch alone, so that a continued training is equal."""
        self.batches.epoch = len(self.history)
        torch.manual_seed(epoch_seed(self.seed, len(self.history)))
        self._train, self._validation = [], []

    def on_train_batch_end(
        self,
        trainer: lightning.Trainer,
        dynamics: lightning.LightningModule,
        outputs: Any,
        batch: Batch,
        batch_idx: int,
    ) -> None:
        """Note the batch's errors."""
        self._train.append(outputs["errors"])

    def on_validation_batch_end(
        self,
        trainer: lightning.Trainer,
        dynamics: lightning.LightningModule,
        outputs: Any,
        batch: Batch,
        batch_idx: int,
        dataloader_idx: int = 0,
    ) -> None:
        """Note the batch's errors and size."""
        self._validation.append((outputs["errors"], len(batch[0])))

    def on_train_epoch_end(self, trainer: lightning.Trainer, dynamics: lightning.LightningModule) -> None:
        """Close the epoch: history, schedule, best weights, checkpoint, report."""
        epoch = self._close_epoch()
        self.history.append(epoch)
        loss = epoch.validation_position_mm + self.heading_weight * math.radians(epoch.validation_orientation_deg)
        scheduler = trainer.lr_scheduler_configs[0].scheduler
        if isinstance(scheduler, ReduceLROnPlateau):
            scheduler.step(loss)
        if loss < self.best_loss:
            self.best_loss, self.best_epoch = loss, len(self.history)
            self.best_weights = {name: tensor.clone() for name, tensor in dynamics.state_dict().items()}
        if self.diverged:
            trainer.should_stop = True
        self._write_checkpoint(trainer, dynamics)
        if self.report:
            self.report(self.seed, len(self.history), epoch)

    def _close_epoch(self) -> Epoch:
        train_mm, train_rad = torch.stack(self._train).mean(dim=0).tolist()
        count = sum(size for _, size in self._validation)
        validation_mm, validation_rad = (
            torch.stack([errors * (size / count) for errors, size in self._validation]).sum(dim=0).tolist()
        )
        return Epoch(train_mm, math.degrees(train_rad), validation_mm, math.degrees(validation_rad))

    def _write_checkpoint(self, trainer: lightning.Trainer, dynamics: lightning.LightningModule) -> None:
        if self.checkpoint is None:
            return
        state = {
            "identity": self.identity,
            "history": [tuple(epoch) for epoch in self.history],
            "best_loss": self.best_loss,
            "best_epoch": self.best_epoch,
            "best_weights": self.best_weights,
            "weights": dynamics.state_dict(),
            "optimiser": trainer.optimizers[0].state_dict(),
            "schedule": trainer.lr_scheduler_configs[0].scheduler.state_dict(),
        }
        content = io.BytesIO()  # a full disk is an OSError to Python, and none to torch
        torch.save(state, content)
        with whole_file(self.checkpoint) as aside:
            aside.write_bytes(content.getbuffer())

    def _read_checkpoint(self) -> dict[str, Any]:
        """Return the checkpoint's content; nothing if there is none, or if it is damaged or of another training."""
        if self.checkpoint is None or not self.checkpoint.exists():
            return {}
        try:
            state = cast(dict[str, Any], torch.load(self.checkpoint, weights_only=True))
        except Exception as error:  # torch.load raises many kinds for a damaged file
            log.warning("seed %d starts anew: checkpoint %s is damaged (%s)", self.seed, self.checkpoint, error)
            return {}
        if not isinstance(state, dict) or state.get("identity") != self.identity:
            log.warning("seed %d starts anew: checkpoint %s is of another training", self.seed, self.checkpoint)
            return {}
        return state
