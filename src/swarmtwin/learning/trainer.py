"""Lightning's trainer with everything off that a small network does not need."""

import logging
import signal
import warnings
from collections.abc import Iterable
from pathlib import Path
from typing import Any

import lightning
from lightning.pytorch.plugins.environments import LightningEnvironment

from swarmtwin.learning.device import Device, torch_device

logging.getLogger("lightning.pytorch").setLevel(logging.WARNING)


def run_trainer(
    module: lightning.LightningModule,
    callback: lightning.Callback,
    batches: Iterable[Any],
    validation: Iterable[Any] | None = None,
    *,
    epochs: int = 1,
    device: Device,
    resume_from: Path | None = None,
) -> None:
    """Train a module until `epochs` are done.

    Args:
        module: what is trained; afterwards it lies on the CPU again.
        callback: follows the training.
        batches: of an epoch.
        validation: batches to measure errors on after each epoch.
        epochs: how many, those before a resumed checkpoint included.
        device: where.
        resume_from: a checkpoint that the trainer saved; nothing but tensors and plain values is loaded from it.

    Raises:
        UserError: a GPU is asked for, and there is none.
        KeyboardInterrupt: Ctrl-C or SIGTERM came.
    """
    chosen = torch_device(device)
    trainer = lightning.Trainer(
        accelerator=chosen.type,
        devices=1 if chosen.index is None else [chosen.index],
        max_epochs=epochs,
        callbacks=[callback],
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
            trainer.fit(module, batches, validation, ckpt_path=resume_from, weights_only=True)
    except SystemExit:  # what Lightning makes of Ctrl-C and SIGTERM
        signal.signal(signal.SIGINT, interrupt_handler)
        raise KeyboardInterrupt from None
