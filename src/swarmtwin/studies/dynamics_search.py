"""Searches hyper-parameters of a dynamics model and of its training."""

import math
from collections.abc import Mapping
from typing import Any, ClassVar, cast

from swarmtwin.dynamics.model_config import ModelConfig, model_config
from swarmtwin.dynamics.training import train
from swarmtwin.dynamics.training_module import Epoch
from swarmtwin.learning.recipe import Recipe
from swarmtwin.robot import StrictModel
from swarmtwin.studies.hyperparameter_search import HyperparameterSearch, LossReport, Outcome
from swarmtwin.tracking.runs import Experiment
from swarmtwin.transitions import Preparation, Transitions


class DynamicsSearch(HyperparameterSearch):
    """The loss is the recipe's, on the validation runs, at a training's best epoch.

    Attributes:
        model: options of the dynamics model, as in conf/model.
        recipe: options of its training, as in conf/recipe.
    """

    experiment: ClassVar[Experiment] = "dynamics"
    headings: ClassVar[Mapping[str, str]] = {
        "validation_position_mm": "position\nmm",
        "validation_orientation_deg": "orientation\n°",
    }

    model: dict[str, Any]
    recipe: dict[str, Any]

    @property
    def options(self) -> dict[str, dict[str, Any]]:
        """The groups `model` and `recipe`."""
        return {"model": self.model, "recipe": self.recipe}

    def parsed(self, options: Mapping[str, dict[str, Any]]) -> dict[str, StrictModel]:
        """Return a `ModelConfig` and a `Recipe`."""
        return {
            "model": model_config(options["model"], "model"),
            "recipe": Recipe.parse(options["recipe"], "recipe"),
        }

    def trained(
        self,
        configs: Mapping[str, StrictModel],
        transitions: Transitions,
        preparation: Preparation,
        report: LossReport,
    ) -> Outcome:
        """Train one seed, in this process."""
        config, recipe = cast(ModelConfig, configs["model"]), cast(Recipe, configs["recipe"])
        epochs = recipe.completed(config.learning_rate, config.steps, len(transitions.part("train"))).epochs or 1

        def tell(_: int, number: int, epoch: Epoch) -> None:
            orientation_rad = math.radians(epoch.validation_orientation_deg)
            loss = epoch.validation_position_mm + recipe.heading_weight * orientation_rad
            report(number, epochs, loss if epoch.finite else math.nan)

        best = train(transitions, config, recipe, [self.seed], report=tell, processes=1, device=self.device).best
        errors = best.history[best.best - 1]
        figures = {name: getattr(errors, name) for name in self.headings}
        return Outcome(best.validation_loss, figures)
