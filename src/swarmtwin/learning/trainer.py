"""Where learning takes place, and Lightning's trainer with everything off that a small network does not need."""

import logging
import signal
import warnings
from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any, Literal

import lightning
import torch
from lightning.pytorch.plugins.environments import LightningEnvironment

from swarmtwin.errors import UserError

logging.getLogger("lightning.pytorch").setLevel(logging.WARNING)

Device = Literal["auto", "cpu", "gpu"]
"""Where to compute: `gpu` wants a GPU (CUDA or ROCm), `auto` takes one where there is one."""


def torch_device(device: Device) -> torch.device:
    """Return the device that the configuration's word means on this machine.

    Raises:
        UserError: a GPU is asked for, and torch finds none.
    """
    if device == "cpu" or (device == "auto" and not torch.cuda.is_available()):
        return torch.device("cpu")
    if not torch.cuda.is_available():
        raise UserError("device: gpu is asked for, but torch finds none here: take device=cpu or device=auto")
    return torch.device("cuda", torch.cuda.current_device())


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


@contextmanager
def one_thread() -> Iterator[None]:
    """Let torch compute on one thread: as quick on nets this small, and the same numbers every time."""
    threads = torch.get_num_threads()
    torch.set_num_threads(1)
    try:
        yield
    finally:
        torch.set_num_threads(threads)


@contextmanager
def reproducible(seed: int, device: Device = "cpu") -> Iterator[None]:
    """Compute on one thread, from the random numbers of a seed; afterwards the caller's go on as if nothing had been.

    Args:
        seed: of torch's random numbers.
        device: where else than on the CPU random numbers are drawn.
    """
    chosen = torch_device(device)
    with one_thread(), torch.random.fork_rng(devices=[chosen] if chosen.type == "cuda" else []):
        torch.manual_seed(seed)
        yield
