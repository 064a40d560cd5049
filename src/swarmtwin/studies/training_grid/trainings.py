"""What the paper's tables and figures are made of: a grid of trainings, each a model and what it learns from."""

import itertools
from collections.abc import Iterator, Mapping, Sequence
from typing import Annotated, Any, Literal, Self

from pydantic import AfterValidator, Field, model_validator

from swarmtwin.errors import near_miss
from swarmtwin.robot import Positive, StrictModel

Share = Annotated[float, Field(gt=0, le=1)]
Equal = Literal["steps", "epochs"]
Value = bool | float | str | None


class Training(StrictModel):
    """One training, of which each seed is a run.

    Attributes:
        model: the dynamics model that learns, a file in conf/model/.
        generator: what it learns from is drawn from this one, a file in conf/generator/; None: it was measured.
        real: share of the real transitions there are, for the model or for its generator. Below 1 each seed draws runs
            of its own.
        synthetic: how many transitions are drawn from the generator, in multiples of all real ones.
        real_share: of a mixture, how much of it was measured; 0 for what was drawn alone.
        generator_epochs: passes of an adversarial generator's training over its real rows; None: its own steps.
        noise: standard deviation of what is added to the displacements that are learned from, in mm and in degrees.
        equal: `steps`: as many optimiser steps as on all real transitions; `epochs`: as many passes over what it learns
            from, as the paper counts.
        history: whether the model is given the commands of the two periods before as well.
        learning_rate: the largest one; None: the recipe's or the model's own.
        steps: optimiser steps on all real transitions; None: the scale's or the model's own.
    """

    model: str
    generator: str | None = None
    real: Share = 1.0
    synthetic: Positive = 1.0
    real_share: Annotated[float, Field(ge=0, lt=1)] = 0.0
    generator_epochs: Positive | None = None
    noise: Annotated[float, Field(ge=0)] = 0.0
    equal: Equal = "steps"
    history: bool = False
    learning_rate: Positive | None = None
    steps: Annotated[int, Field(ge=1)] | None = None

    @model_validator(mode="after")
    def _drawn_transitions_have_no_history(self) -> Self:
        if self.history and self.generator:
            raise ValueError("history: true needs measured transitions: what is drawn knows no commands before")
        return self

    @property
    def size(self) -> float:
        """How much it learns from, in multiples of all real transitions: measured ones, or those drawn."""
        return self.real if self.generator is None else self.synthetic

    @property
    def measured_share(self) -> float:
        """How much of what it learns from was measured."""
        return 1.0 if self.generator is None else self.real_share

    @property
    def as_many_as_real(self) -> bool:
        """Whether it learns from as many transitions as there are real ones, so that steps and epochs are the same."""
        return self.size == 1 or self.real_share > 0

    def title(self, real: int) -> str:
        """Return what a person reads, `-R` and `-S` as in the paper.

        Args:
            real: how many real transitions there are.
        """
        given = [f"given {name}" for name, there in (("the commands before", self.history),) if there]
        if self.real < 1:
            given.append(f"{round(self.real * real):,} real")
        if self.generator is None:
            name = f"{self.model}-R"
        else:
            name = f"{self.model}-S ({self.generator})"
            if self.real_share:
                name = f"{self.model}, {self.real_share:.0%} real ({self.generator})"
            elif self.synthetic != 1:
                given.append(f"{round(self.synthetic * real):,} synthetic")
        if self.generator_epochs is not None:
            given.append(f"{self.generator_epochs:g} epochs of the generator")
        if self.noise:
            given.append(f"noise of {self.noise:g} mm and °")
        if self.equal == "epochs":
            given.append("equal epochs")
        return ", ".join((name, *given))


FIELDS = (*Training.model_fields, "size", "measured_share")


def _known_fields(selector: dict[str, Any]) -> dict[str, Any]:
    for name in selector:
        if name not in FIELDS:
            raise ValueError(f"no such field of a training: {name!r}: {near_miss(name, FIELDS)}")
    return selector


Selector = Annotated[dict[str, Value | tuple[Value, ...]], AfterValidator(_known_fields)]
"""Chooses trainings: of each field named, the value or the values that it may have."""

FieldName = Annotated[str, AfterValidator(lambda name: next(iter(_known_fields({name: None}))))]


def chosen(trainings: Sequence[Training], selector: Mapping[str, Value | tuple[Value, ...]]) -> list[Training]:
    """Return those of some trainings that a selector chooses."""

    def fits(training: Training) -> bool:
        return all(
            getattr(training, name) in (values if isinstance(values, tuple) else (values,))
            for name, values in selector.items()
        )

    return [training for training in trainings if fits(training)]


class Grid(StrictModel):
    """All combinations of some values of each field of a training, as `Training` names the fields.

    Attributes:
        generators: none: measured transitions.
        equal: how long data sets of unlike sizes are trained on.
    """

    models: Annotated[tuple[str, ...], Field(min_length=1)]
    generators: tuple[str, ...] = ()
    real: tuple[Share, ...] = (1.0,)
    synthetic: tuple[Positive, ...] = (1.0,)
    real_share: tuple[Share | Literal[0], ...] = (0.0,)
    generator_epochs: tuple[Positive | None, ...] = (None,)
    noise: tuple[Annotated[float, Field(ge=0)], ...] = (0.0,)
    equal: tuple[Equal, ...] = ("steps",)
    history: bool = False
    learning_rate: Positive | None = None
    steps: Annotated[int, Field(ge=1)] | None = None

    def trainings(self) -> Iterator[Training]:
        """Yield every combination; one whose mixture is all measured learns from measured transitions."""
        axes = {
            "model": self.models,
            "generator": self.generators or (None,),
            "real": self.real,
            "synthetic": self.synthetic,
            "real_share": self.real_share,
            "generator_epochs": self.generator_epochs,
            "noise": self.noise,
            "equal": self.equal,
        }
        same = {"history": self.history, "learning_rate": self.learning_rate, "steps": self.steps}
        for values in itertools.product(*axes.values()):
            fields = dict(zip(axes, values, strict=True)) | same
            if fields["generator"] is None or fields["real_share"] == 1:
                fields |= {"generator": None, "synthetic": 1.0, "real_share": 0.0, "generator_epochs": None}
            yield Training.model_validate(fields)


def all_trainings(grids: Sequence[Grid]) -> list[Training]:
    """Return the trainings of some grids, each once, in order."""
    return list(dict.fromkeys(training for grid in grids for training in grid.trainings()))
