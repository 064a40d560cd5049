"""Trains a generator: the same seed gives the same numbers."""

from collections.abc import Callable
from typing import Any

import lightning
import numpy as np

from swarmtwin.errors import UserError
from swarmtwin.generators.columns import Columns
from swarmtwin.generators.generator import Generator, GeneratorConfig, RealRows
from swarmtwin.learning.device import Device, reproducible
from swarmtwin.learning.trainer import run_trainer
from swarmtwin.learning.trainer_settings import LiveCurves, TrainerSettings
from swarmtwin.transitions import Transitions

Record = dict[str, float]
"""A step's number, the mean losses since the record before, and the figures on the validation rows."""

Report = Callable[[Record, int], None]
"""Told each record as it is closed, and how many steps the whole training takes."""


def fit(
    transitions: Transitions,
    config: GeneratorConfig,
    seed: int,
    report: Report | None = None,
    device: Device = "cpu",
    trainer: TrainerSettings | None = None,
    curves: LiveCurves | None = None,
) -> tuple[Generator, list[Record]]:
    """Train a generator on the training split, on one thread; return it with the history of its training.

    Args:
        transitions: real ones.
        config: which generator.
        seed: of initial weights and of the rows that each step takes.
        report: told each record of the history.
        device: where to train; the generator lies on the CPU afterwards.
        trainer: everything else of Lightning's trainer; None: its defaults, of which nothing is seen.
        curves: the run that the records are sent to as they are closed; None: none.

    Raises:
        UserError: too little data, values that are not finite, a training that diverged, or no GPU where one is asked
            for.
    """
    columns = Columns.of(transitions.robot, transitions.arena_mm)
    real = RealRows.of(transitions, columns)
    config = config.completed(len(real.train))
    with reproducible(seed, device):
        generator = config.build(columns)
        history = HistoryCallback(config.training_steps, report)
        batches = range(config.training_steps)
        run_trainer(config.training(generator, real), history, batches, device=device, settings=trainer, curves=curves)
    if any(not weights.isfinite().all() for weights in generator.state_dict().values()):
        raise UserError(f"{config.name}: the training diverged: lower the learning rate, or take another seed")
    return generator.cpu().eval(), history.records


class HistoryCallback(lightning.Callback):
    """Records losses and validation figures while a generator is trained, at evenly spaced steps.

    Args:
        steps: of the whole training.
        report: told each record as it is closed.
        records: about how many there are to be.
    """

    def __init__(self, steps: int, report: Report | None, records: int = 40) -> None:
        self.every = max(1, steps // records)
        self.steps = steps
        self.report = report
        self.records: list[Record] = []
        self._losses: dict[str, list[float]] = {}

    def on_train_batch_end(
        self, trainer: lightning.Trainer, training: Any, outputs: Any, batch: int, batch_index: int
    ) -> None:
        """Note the losses; every so often close a record."""
        for name, loss in outputs.items():
            self._losses.setdefault(name, []).append(float(loss))
        step = batch_index + 1
        if step % self.every and step != self.steps:
            return
        losses = {name: float(np.mean(values)) for name, values in self._losses.items()}
        self.records.append({"step": step, **losses, **training.validation_figures()})
        self._losses.clear()
        if trainer.logger:
            trainer.logger.log_metrics(
                {name: value for name, value in self.records[-1].items() if name != "step"}, step
            )
        if self.report:
            self.report(self.records[-1], self.steps)
