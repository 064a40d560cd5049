"""Lightning's trainer with everything off that a small network in memory does not need: quick, and repeatable."""

import logging
import signal
import warnings
from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from typing import Any

import lightning
import torch
from lightning.pytorch.plugins.environments import LightningEnvironment

logging.getLogger("lightning.pytorch").setLevel(logging.WARNING)


def run_trainer(
    module: lightning.LightningModule,
    callback: lightning.Callback,
    batches: Iterable[Any],
    validation: Iterable[Any] | None = None,
    epochs: int = 1,
) -> None:
    """Train a module on this processor.

    Raises:
        KeyboardInterrupt: Ctrl-C or SIGTERM came.
    """
    trainer = lightning.Trainer(
        accelerator="cpu",
        devices=1,
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
            trainer.fit(module, train_dataloaders=batches, val_dataloaders=validation)
    except SystemExit:  # what Lightning makes of Ctrl-C and SIGTERM
        signal.signal(signal.SIGINT, interrupt_handler)
        raise KeyboardInterrupt from None


@contextmanager
def one_thread() -> Iterator[None]:
    """Let torch compute on one thread: as quick on nets this small, and the same numbers every time."""
    threads = torch.get_num_threads()
    torch.set_num_threads(1)
    try:
        yield
    finally:
        torch.set_num_threads(threads)
