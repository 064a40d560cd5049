"""Trains a generator: the same seed gives the same numbers."""

from collections.abc import Callable
from typing import Any

import lightning
import numpy as np
import torch

from swarmtwin.errors import UserError
from swarmtwin.generators.base import Generator, RealRows
from swarmtwin.generators.columns import Columns
from swarmtwin.generators.generator_config import GeneratorConfig
from swarmtwin.trainer import one_thread, run_trainer
from swarmtwin.transitions import Transitions

RECORDS = 40

Record = dict[str, float]
"""A step's number, the mean losses since the record before, and the figures on the validation rows."""

Report = Callable[[Record], None]


def fit(
    transitions: Transitions, config: GeneratorConfig, seed: int, report: Report | None = None
) -> tuple[Generator, list[Record]]:
    """Train a generator on the training split, on one thread; return it with the history of its training.

    Raises:
        UserError: too little data, values that are not finite, or a training that diverged.
    """
    real = RealRows.of(transitions, Columns.of(transitions.robot))
    with one_thread(), torch.random.fork_rng(devices=[]):
        torch.manual_seed(seed)
        generator = config.build(transitions.robot)
        generator.start(real)
        following = Following(config.training_steps, report)
        run_trainer(generator, following, range(config.training_steps))
    if any(not weights.isfinite().all() for weights in generator.state_dict().values()):
        raise UserError(f"{config.name}: the training diverged: lower the learning rate, or take another seed")
    return generator.eval(), following.history


class Following(lightning.Callback):
    """Records the training as it goes on, at evenly spaced steps."""

    def __init__(self, steps: int, report: Report | None) -> None:
        self.every = max(1, steps // RECORDS)
        self.steps = steps
        self.report = report
        self.history: list[Record] = []
        self._losses: dict[str, list[float]] = {}

    def on_train_batch_end(
        self, trainer: lightning.Trainer, generator: Any, outputs: Any, batch: int, batch_index: int
    ) -> None:
        """Note the losses; every so often close a record."""
        for name, loss in outputs.items():
            self._losses.setdefault(name, []).append(float(loss))
        step = batch_index + 1
        if step % self.every and step != self.steps:
            return
        losses = {name: float(np.mean(values)) for name, values in self._losses.items()}
        self.history.append({"step": step, **losses, **generator.validation_figures()})
        self._losses.clear()
        if self.report:
            self.report(self.history[-1])
