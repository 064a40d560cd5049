"""How a dynamics model is trained: optimiser, schedule, batches and the unit of the heading's loss."""

import math
from collections.abc import Iterable
from functools import partial
from typing import Annotated, Any, Literal, Self

from pydantic import Field, field_validator
from torch import nn
from torch.optim import AdamW, Optimizer
from torch.optim.lr_scheduler import LambdaLR, LRScheduler, ReduceLROnPlateau

from swarmtwin.robot import Positive, StrictModel

Fraction = Annotated[float, Field(ge=0, lt=1)]


class OneCycle(StrictModel):
    """The learning rate rises over the first part of the steps and then falls to nothing along a cosine."""

    kind: Literal["one_cycle"] = "one_cycle"
    warm_up: Fraction = 0.1

    def share(self, step: int, steps: int) -> float:
        """Return the share of the largest learning rate at `step`, from 0, of a training of `steps` steps."""
        warm_up_steps = self.warm_up * steps
        if step < warm_up_steps:
            return (step + 1) / (warm_up_steps + 1)
        return (1 + math.cos(math.pi * (step - warm_up_steps) / (steps - warm_up_steps))) / 2


class Plateau(StrictModel):
    """The learning rate is cut when the validation loss has not improved for `patience` epochs (authors' code)."""

    kind: Literal["plateau"] = "plateau"
    patience: Annotated[int, Field(ge=0)] = 2
    factor: Fraction = 0.5
    lowest_learning_rate: Annotated[float, Field(ge=0)] = 1e-6


class Recipe(StrictModel):
    """How to train. Where learning rate or epochs are null, the model's own (in its YAML) hold.

    The loss is the mean Euclidean position error in mm plus the mean absolute heading error in `heading_loss_unit`.

    Attributes:
        name: the file's name.
        learning_rate: largest learning rate.
        epochs: passes over the training data.
        batch_size: transitions a step.
        betas: AdamW's averaging of gradient and squared gradient.
        weight_decay: AdamW's.
        schedule: how the learning rate changes.
        heading_loss_unit: a radian weighs as much as a millimetre in the authors' code; a degree does with `deg`.
    """

    name: str
    learning_rate: Positive | None
    epochs: Annotated[int, Field(ge=1)] | None
    batch_size: Annotated[int, Field(ge=2)]
    betas: tuple[Fraction, Fraction]
    weight_decay: Annotated[float, Field(ge=0)]
    schedule: OneCycle | Plateau = Field(discriminator="kind")
    heading_loss_unit: Literal["rad", "deg"]

    @field_validator("schedule", mode="before")
    @classmethod
    def _of_one_kind(cls, schedule: Any) -> Any:
        """Refuse what another kind of schedule left: on the command line `kind` alone is easily changed."""
        fields_of = {"one_cycle": OneCycle.model_fields, "plateau": Plateau.model_fields}
        if not isinstance(schedule, dict) or (chosen := schedule.get("kind")) not in fields_of:
            return schedule
        for kind, fields in fields_of.items():
            if kind != chosen and (left := [name for name in schedule if name in fields and name != "kind"]):
                removed = " ".join(f"~recipe.schedule.{name}" for name in left)
                raise ValueError(f"{', '.join(left)} belongs to {kind!r}, not to {chosen!r}: take it away by {removed}")
        return schedule

    def completed(self, learning_rate: float, steps: int, transitions: int) -> Self:
        """Fill in a model's own learning rate and steps where this recipe leaves them open.

        Args:
            learning_rate: the model's own.
            steps: the model's own number of optimiser steps, rounded up to whole epochs.
            transitions: how many there are to train on: with fewer, the same number of steps takes more epochs.
        """
        steps_per_epoch = max(1, transitions // self.batch_size)
        own = {"learning_rate": learning_rate, "epochs": math.ceil(steps / steps_per_epoch)}
        return self.model_copy(update={name: value for name, value in own.items() if getattr(self, name) is None})

    @property
    def heading_weight(self) -> float:
        """What the loss multiplies a heading error in rad by."""
        return 180 / math.pi if self.heading_loss_unit == "deg" else 1.0

    def optimiser(self, parameters: Iterable[nn.Parameter]) -> Optimizer:
        """Build the optimiser of a recipe whose learning rate is known."""
        assert self.learning_rate is not None
        return AdamW(parameters, lr=self.learning_rate, betas=self.betas, weight_decay=self.weight_decay, fused=True)

    def scheduler(self, optimiser: Optimizer, steps: int) -> LRScheduler:
        """Build the schedule of a training of `steps` steps."""
        if isinstance(self.schedule, Plateau):
            chosen = self.schedule
            return ReduceLROnPlateau(
                optimiser, patience=chosen.patience, factor=chosen.factor, min_lr=chosen.lowest_learning_rate
            )
        return LambdaLR(optimiser, partial(self.schedule.share, steps=steps))
