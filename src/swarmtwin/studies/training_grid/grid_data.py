"""What each training of a grid learns from, and by which settings: resolved from configurations and recordings."""

import math
from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Any, NamedTuple

import numpy as np

from swarmtwin.dynamics.model_config import ModelConfig
from swarmtwin.errors import UserError
from swarmtwin.generators.generator import GeneratorConfig
from swarmtwin.learning.recipe import Recipe
from swarmtwin.studies.training_grid.training_store import key_of
from swarmtwin.studies.training_grid.trainings import Training
from swarmtwin.studies.training_sets import count_real, described_part
from swarmtwin.transitions import SPLITS, Transitions, first_runs
from swarmtwin.transitions.mixing import Prepared


class RealPart(NamedTuple):
    """Some of the real transitions.

    Attributes:
        digest: of their content.
        rows: how many are for training.
    """

    digest: str
    rows: int


@dataclass(frozen=True)
class GridData:
    """All that the trainings of a grid are made of.

    Attributes:
        real: all real transitions, and how they came about.
        models: the configurations of the dynamics models, by name.
        generators: likewise of the generators.
        recipe: how models are trained.
        steps: optimiser steps on all real transitions, for recipes that leave them open; None: each model's own.
    """

    real: Prepared
    models: Mapping[str, ModelConfig]
    generators: Mapping[str, GeneratorConfig]
    recipe: Recipe
    steps: int | None

    @property
    def count(self) -> int:
        """How many real transitions there are to learn from, training and validation together."""
        return count_real(self.real[1])

    def real_part(self, training: Training, seed: int) -> Prepared:
        """Return the real transitions that a training, or its generator, is given.

        Raises:
            UserError: there are too few runs.
        """
        if training.real == 1:
            return self.real
        return described_part(self.real[1], drawn_runs(self.real[0], round(training.real * self.count), seed))

    def model_config(self, training: Training) -> ModelConfig:
        """Return the configuration of a training's model, given the commands before where it is to be."""
        config = self.models[training.model]
        if not training.history:
            return config
        given = dict.fromkeys((*config.inputs(self.real[0].robot), "previous_command", "earlier_command"))
        return config.model_copy(update={"situation": tuple(given)})

    def generator_config(self, training: Training, rows: int) -> GeneratorConfig:
        """Return the configuration of a training's generator, which learns from so many rows as long as it is to.

        Raises:
            UserError: passes over real rows are asked for of a generator that has none.
        """
        assert training.generator is not None
        config = self.generators[training.generator]
        return config if training.generator_epochs is None else with_epochs(config, training.generator_epochs, rows)

    def recipe_for(self, training: Training, rows: int) -> Recipe:
        """Return how a training goes that learns from so many rows: at equal steps, or at equal epochs.

        Either is as on all real transitions, whatever the recipe and the model make of those.
        """
        config, everything = self.models[training.model], len(self.real[0].part("train"))
        recipe = self.recipe
        if training.learning_rate is not None:
            recipe = recipe.model_copy(update={"learning_rate": training.learning_rate})
        wanted = training.steps or self.steps or config.steps
        recipe = recipe.completed(config.learning_rate, wanted, everything)
        epochs = recipe.epochs or 1
        if training.equal == "epochs" and not training.as_many_as_real:
            return recipe
        total = epochs * steps_an_epoch(recipe, everything)
        return recipe.model_copy(update={"epochs": math.ceil(total / steps_an_epoch(recipe, rows))})

    def identified_part(self, training: Training, seed: int) -> "RealPart":
        """Return what tells the real transitions that a training is given from others."""
        part, _ = self.real_part(training, seed)
        return RealPart(part.digest(), len(part.part("train")))

    def generator_made_of(self, training: Training, seed: int, real: "RealPart") -> dict[str, Any]:
        """Return all that decides what comes of a training's generator, given those real transitions."""
        return {
            "robot": self.real[0].robot.model_dump(mode="json"),
            "generator": self.generator_config(training, real.rows).model_dump(mode="json"),
            "real": real.digest,
            "seed": seed,
        }

    def made_of(self, training: Training, seed: int, real: "RealPart", everything: "RealPart") -> dict[str, Any]:
        """Return all that decides what comes of a training.

        Args:
            training: which.
            seed: of it.
            real: the real transitions that it, or its generator, is given.
            everything: all real transitions.
        """
        as_on_all = training.model_copy(update={"real": 1.0})
        made_of: dict[str, Any] = {
            "robot": self.real[0].robot.model_dump(mode="json"),
            "model": self.model_config(training).model_dump(mode="json"),
            "recipe": self.recipe_for(as_on_all, everything.rows).model_dump(mode="json"),
            "all_rows": everything.rows,
            "equal": "steps" if training.as_many_as_real else training.equal,
            "real": real.digest,
            "noise": training.noise,
            "seed": seed,
        }
        if training.generator:
            made_of["generator"] = key_of(self.generator_made_of(training, seed, real))
            made_of["synthetic"] = self.drawn_count(training)
            made_of["mixed_with"] = [training.real_share, everything.digest] if training.real_share else None
        return made_of

    def drawn_count(self, training: Training) -> int:
        """Return how many transitions are drawn from a training's generator."""
        return round(training.synthetic * self.count)


def steps_an_epoch(recipe: Recipe, rows: int) -> int:
    """Return how many optimiser steps a pass over so many rows takes."""
    return max(1, rows // min(recipe.batch_size, rows))


def drawn_runs(transitions: Transitions, count: int, seed: int) -> Transitions:
    """Keep whole runs, drawn at random, that make about `count` transitions for training and validation together.

    Raises:
        UserError: there are fewer.
    """
    order = np.random.default_rng(seed).permutation(len(transitions.runs))
    shuffled = transitions.where(np.argsort(order[transitions.run], kind="stable"))
    kept = np.unique(first_runs(shuffled, count).run)
    return transitions.where(np.isin(transitions.run, kept) & (transitions.split != SPLITS.index("test")))


def with_noise(transitions: Transitions, sd: float, seed: int) -> Transitions:
    """Add normal noise to the displacements that are trained on, of `sd` mm forward and left and `sd` degrees."""
    if not sd:
        return transitions
    scale = np.array([sd, sd, np.radians(sd)])
    drawn = np.random.default_rng(seed).normal(0.0, scale, transitions.displacement.shape)
    trained_on = transitions.split == SPLITS.index("train")
    return replace(transitions, displacement=transitions.displacement + drawn * trained_on[:, None])


def with_epochs(config: GeneratorConfig, epochs: float, rows: int) -> GeneratorConfig:
    """Return the configuration of an adversarial generator whose discriminator passes so often over its real rows.

    Raises:
        UserError: the generator does not learn from half batches of real rows.
    """
    half_batch, times = getattr(config, "batch_size", 0) // 2, getattr(config, "discriminator_steps", 0)
    if not half_batch * times or "steps" not in type(config).model_fields:
        raise UserError(
            f"generator {config.name!r} has no batch_size, discriminator_steps and steps, so that its epochs cannot be "
            "set: leave it out of the figure of the generator's epochs"
        )
    return config.model_copy(update={"steps": max(1, round(epochs * rows / (half_batch * times)))})
