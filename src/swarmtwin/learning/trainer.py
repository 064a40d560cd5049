"""Lightning's trainer: by default with everything off that a small network does not need."""

import logging
import signal
import warnings
from collections.abc import Iterable
from pathlib import Path
from typing import Any

import lightning
from lightning.pytorch.callbacks import EarlyStopping, RichProgressBar
from lightning.pytorch.loggers import MLFlowLogger
from lightning.pytorch.plugins.environments import LightningEnvironment

from swarmtwin.learning.device import Device, torch_device
from swarmtwin.learning.trainer_settings import LiveCurves, TrainerSettings

logging.getLogger("lightning.pytorch").setLevel(logging.WARNING)

VALIDATION_LOSS = "validation_loss"
"""What a training that may end early reports to Lightning after each epoch."""


class RunLogger(MLFlowLogger):
    """Lightning's logger for a run that somebody else opened and will close: several seeds write to it."""

    def finalize(self, status: str = "success") -> None:
        """Leave the run open."""


def run_trainer(
    module: lightning.LightningModule,
    callback: lightning.Callback,
    batches: Iterable[Any],
    validation: Iterable[Any] | None = None,
    *,
    epochs: int = 1,
    device: Device,
    resume_from: Path | None = None,
    settings: TrainerSettings | None = None,
    curves: LiveCurves | None = None,
    prefix: str = "",
) -> None:
    """Train a module until `epochs` are done, or until it is told to end.

    Args:
        module: what is trained; afterwards it lies on the CPU again.
        callback: follows the training.
        batches: of an epoch.
        validation: batches to measure errors on after each epoch.
        epochs: how many, those before a resumed checkpoint included.
        device: where; it goes before that of the settings.
        resume_from: a checkpoint that the trainer saved; nothing but tensors and plain values is loaded from it.
        settings: everything else; by default one process in single precision, of which nothing is seen.
        curves: the run that the module's errors are sent to; None: none.
        prefix: of their names there, which tells the trainings of a run apart.

    Raises:
        UserError: a GPU is asked for, and there is none.
        KeyboardInterrupt: Ctrl-C or SIGTERM came.
    """
    chosen = torch_device(device)
    settings = settings or TrainerSettings(progress_bar="none")
    one_device: int | list[int] = 1 if chosen.index is None else [chosen.index]
    trainer = lightning.Trainer(
        accelerator=chosen.type,
        devices=one_device if settings.processes == 1 else settings.processes,
        strategy=settings.strategy,
        precision=settings.precision,
        max_epochs=epochs,
        callbacks=[callback, *_callbacks(settings)],
        plugins=[LightningEnvironment()],
        logger=RunLogger(run_id=curves.run_id, tracking_uri=curves.store, prefix=prefix) if curves else False,
        enable_checkpointing=False,
        enable_progress_bar=settings.progress_bar == "rich",
        enable_model_summary=False,
        num_sanity_val_steps=0,
    )
    interrupt_handler = signal.getsignal(signal.SIGINT)
    try:
        with warnings.catch_warnings():
            warnings.filterwarnings("ignore", module=r"lightning\.")
            trainer.fit(module, batches, validation, ckpt_path=resume_from, weights_only=True)
    except SystemExit:  # what Lightning makes of Ctrl-C and SIGTERM
        signal.signal(signal.SIGINT, interrupt_handler)
        raise KeyboardInterrupt from None


def _callbacks(settings: TrainerSettings) -> list[lightning.Callback]:
    """Return Lightning's own callbacks that the settings ask for."""
    chosen: list[lightning.Callback] = [RichProgressBar()] if settings.progress_bar == "rich" else []
    if settings.patience_epochs is not None:
        chosen.append(EarlyStopping(VALIDATION_LOSS, patience=settings.patience_epochs, check_on_train_epoch_end=True))
    return chosen
