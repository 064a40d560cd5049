"""Lightning's trainer: by default with everything off that a small network does not need."""

import logging
import signal
import warnings
from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any, cast

import lightning
import torch
from lightning.fabric.utilities.exceptions import MisconfigurationException
from lightning.pytorch.callbacks import EarlyStopping, RichProgressBar
from lightning.pytorch.loggers import MLFlowLogger
from lightning.pytorch.plugins.environments import LightningEnvironment

from swarmtwin.errors import UserError
from swarmtwin.learning.device import Device, torch_device
from swarmtwin.learning.trainer_settings import LiveCurves, TrainerSettings

logging.getLogger("lightning.pytorch").setLevel(logging.WARNING)
logging.getLogger("lightning.pytorch.profilers").setLevel(logging.INFO)  # one that is asked for tells what it found

VALIDATION_LOSS = "validation_loss"
"""What a training that may end early reports to Lightning after each epoch."""


class RunLogger(MLFlowLogger):
    """Lightning's logger for a run that somebody else opened and will close: several seeds write to it."""

    def finalize(self, status: str = "success") -> None:
        """Leave the run open."""


class GradientClipping(lightning.Callback):
    """Clips gradients before each step of each optimiser, as Lightning does where it takes the steps itself.

    Here modules take them (`automatic_optimization = False`), and Lightning refuses to clip.

    Args:
        most: the largest norm of an optimiser's gradients, or the largest of each.
        by_value: whether it is of each.
    """

    def __init__(self, most: float, by_value: bool) -> None:
        self._most = most
        self._clip = torch.nn.utils.clip_grad_value_ if by_value else torch.nn.utils.clip_grad_norm_

    def on_train_start(self, trainer: lightning.Trainer, module: lightning.LightningModule) -> None:
        """Have each optimiser clip before it steps."""
        for optimiser in trainer.optimizers:
            optimiser.register_step_pre_hook(self._before_step)

    def _before_step(self, optimiser: torch.optim.Optimizer, *_: Any) -> None:
        self._clip([weights for group in optimiser.param_groups for weights in group["params"]], self._most)


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
        UserError: a GPU is asked for, and there is none, or Lightning refuses an option of the settings.
        KeyboardInterrupt: Ctrl-C or SIGTERM came.
    """
    chosen = torch_device(device)
    settings = settings or TrainerSettings(progress_bar="none")
    one_device: int | list[int] = 1 if chosen.index is None else [chosen.index]
    options: dict[str, Any] = dict(settings.options)
    with _told_of(options, MisconfigurationException, TypeError, ValueError, AttributeError):
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
            **options,
        )
    if most := trainer.gradient_clip_val:
        clipping = GradientClipping(most, by_value=trainer.gradient_clip_algorithm == "value")
        cast(Any, trainer).callbacks.append(clipping)
        trainer.gradient_clip_val = None
    interrupt_handler = signal.getsignal(signal.SIGINT)
    try:
        with warnings.catch_warnings(), _told_of(options, MisconfigurationException):
            warnings.filterwarnings("ignore", module=r"lightning\.")
            trainer.fit(module, batches, validation, ckpt_path=resume_from, weights_only=True)
    except SystemExit:  # what Lightning makes of Ctrl-C and SIGTERM
        signal.signal(signal.SIGINT, interrupt_handler)
        raise KeyboardInterrupt from None
    if options and trainer.fit_loop.epoch_loop.total_batch_idx < 0:
        raise UserError(f"trainer.options: nothing is learned with {_text(options)}: let it take a step")


@contextmanager
def _told_of(options: dict[str, Any], *kinds: type[Exception]) -> Iterator[None]:
    """Turn what Lightning does not take of its own options, by these kinds of errors, into one clear message."""
    try:
        yield
    except kinds as error:
        if not options:
            raise
        reason = " ".join(str(error).split())
        raise UserError(f"trainer.options: Lightning refuses {_text(options)}: {reason}") from error


def _text(options: dict[str, Any]) -> str:
    return ", ".join(f"{name}={value}" for name, value in options.items())


def _callbacks(settings: TrainerSettings) -> list[lightning.Callback]:
    """Return Lightning's own callbacks that the settings ask for."""
    chosen: list[lightning.Callback] = [RichProgressBar()] if settings.progress_bar == "rich" else []
    if settings.patience_epochs is not None:
        chosen.append(EarlyStopping(VALIDATION_LOSS, patience=settings.patience_epochs, check_on_train_epoch_end=True))
    return chosen
