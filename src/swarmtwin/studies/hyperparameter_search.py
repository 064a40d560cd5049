"""A search for hyper-parameters of a dynamics model: trials of one Optuna study, trained side by side."""

import logging
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import optuna
from optuna.trial import TrialState

from swarmtwin.dynamics.model_config import ModelConfig, model_config
from swarmtwin.dynamics.training import train
from swarmtwin.dynamics.training_module import Epoch
from swarmtwin.errors import UserError, near_miss
from swarmtwin.learning.device import Device
from swarmtwin.learning.parallel import Report, run_side_by_side
from swarmtwin.learning.progress_bars import quieter
from swarmtwin.learning.recipe import Recipe
from swarmtwin.learning.tuning import Range, SharedStudy, identity, trials_done
from swarmtwin.robot import Robot, Seed, StrictModel
from swarmtwin.studies.tracked_inputs import split_inputs
from swarmtwin.tracking.datasets import Dataset
from swarmtwin.tracking.runs import close_orphans, parent_run, tracked_run
from swarmtwin.transitions import Preparation, SplitOptions, Transitions
from swarmtwin.transitions.inputs import Vehicles, training_transitions

logger = logging.getLogger(__name__)


class HyperparameterSearch(StrictModel):
    """What is searched: where each option may lie, and all that stays the same.

    Attributes:
        robot: whose motion is learned.
        model: options of the dynamics model, as in conf/model.
        recipe: options of its training, as in conf/recipe.
        space: the options searched, such as `recipe.learning_rate`.
        split: of a recording by runs.
        transitions: the folder to learn from, or
        recording: the recording to learn from.
        vehicles: of the recording, None for all.
        device: where models are trained.
        seed: of the sampler and of each training.
        prune: whether a trial is broken off that, a tenth of its training after the other, is worse than half of the
            others were there.
    """

    robot: Robot
    model: dict[str, Any]
    recipe: dict[str, Any]
    space: dict[str, Range]
    split: SplitOptions
    transitions: Path | None
    recording: Path | None
    vehicles: Vehicles
    device: Device
    seed: Seed
    prune: bool

    def run(self, name: str | None, storage: str | None, trials: int, workers: int) -> optuna.Study:
        """Search until the study holds as many trials as asked for, and return it.

        Args:
            name: of the study; None: one made of what it is for.
            storage: a journal file or a database's URL; None: a journal under outputs/tune.
            trials: that end, well or badly, those of former calls among them.
            workers: processes that work on them.

        Raises:
            UserError: an option of the space does not exist, the data or the storage are at fault, or the study was
                made for something else.
        """
        whole_numbers = self._check_space()
        transitions, preparation, _ = self.data()
        prefix = f"{self.robot.name}-{self.model['name']}"
        shared = SharedStudy.named(name, prefix, storage, self._made_for(transitions.robot, preparation))
        study = shared.open()
        done = trials_done(study)
        logger.info("study %s in %s: %d trials there, %d asked for", shared.name, shared.place, done, trials)
        shares = [len(range(number, trials - done, workers)) for number in range(workers)]
        jobs = [
            _Worker(self, shared, whole_numbers, share, number, alone=workers == 1)
            for number, share in enumerate(shares)
            if share
        ]
        if not jobs:
            close_orphans("dynamics")
        else:
            with parent_run("dynamics", f"tune {shared.name}", "study"):
                run_side_by_side(jobs, None, len(jobs))
        return study

    def data(self) -> tuple[Transitions, Preparation, Path]:
        """Return what is learned from, how it came about, and the folder that it comes from."""
        return training_transitions(self.robot, self.transitions, self.recording, self.vehicles, self.split)

    def configured(self, values: Mapping[str, Any]) -> tuple[ModelConfig, Recipe]:
        """Return model and recipe with the values of a trial put in."""
        groups = {"model": dict(self.model), "recipe": dict(self.recipe)}
        for name, value in values.items():
            group, field = name.split(".", 1)
            groups[group][field] = value
        return model_config(groups["model"], "model"), Recipe.parse(groups["recipe"], "recipe")

    def _check_space(self) -> frozenset[str]:
        """Refuse a space whose options do not exist or refuse its values; return those that take whole numbers."""
        known = [f"{group}.{field}" for group in ("model", "recipe") for field in getattr(self, group)]
        for name in self.space:
            if name not in known:
                raise UserError(f"space: no option {name!r}: {near_miss(name, known)}")
        self.configured({})
        try:
            return frozenset(
                name
                for name, found in self.space.items()
                if found.takes_whole_numbers(name, partial(self._configured_with, name))
            )
        except UserError as error:
            raise UserError(f"space: {error}") from None

    def _configured_with(self, name: str, value: Any) -> tuple[ModelConfig, Recipe]:
        return self.configured({name: value})

    def _made_for(self, robot: Robot, preparation: Preparation) -> dict[str, str]:
        """Identify what the trials of a study have in common: everything but the values searched, and the seed."""
        config, recipe = self.configured({})
        groups = {"model": config.model_dump(mode="json"), "recipe": recipe.model_dump(mode="json")}
        for name in self.space:
            group, field = name.split(".", 1)
            del groups[group][field]
        return identity(
            {
                "robot": robot.model_dump(mode="json"),
                **groups,
                "space": {name: found.model_dump(mode="json") for name, found in self.space.items()},
                "data": [preparation.digest, preparation.vehicles],
                "split": preparation.model_dump(mode="json", include={"fractions", "seed"}),
            }
        )


@dataclass(frozen=True)
class _Worker:
    """One process's share of the trials.

    Attributes:
        search: what is searched.
        shared: the study that all workers add to.
        whole_numbers: the options that take whole numbers alone.
        trials: how many it adds.
        number: of the worker.
        alone: whether no other worker adds trials meanwhile.
    """

    search: HyperparameterSearch
    shared: SharedStudy
    whole_numbers: frozenset[str]
    trials: int
    number: int
    alone: bool

    def _sampler(self, study: optuna.Study) -> optuna.samplers.BaseSampler:
        """Return what draws the next trial: the same one again, where a kill has left the last unfinished."""
        drawn = np.random.SeedSequence(self.search.seed, spawn_key=(trials_done(study), self.number))
        return optuna.samplers.TPESampler(seed=int(drawn.generate_state(1)[0]), constant_liar=not self.alone)

    def run(self, report: Report | None) -> None:
        """Add the trials to the study; one that fails is told in a line and counts as failed."""
        transitions, _, source = self.search.data()
        inputs = split_inputs(source, transitions, ("train", "validation"))
        study = self.shared.open()
        pruner = optuna.pruners.MedianPruner(n_startup_trials=10, n_warmup_steps=1)
        study.pruner = pruner if self.search.prune else optuna.pruners.NopPruner()
        for _ in range(self.trials):
            study.sampler = self._sampler(study)
            trial = study.ask()
            try:
                loss = self._loss(trial, transitions, inputs)
            except (UserError, RuntimeError, MemoryError) as error:
                reason = (str(error).strip().splitlines() or ["out of memory"])[0]
                logger.warning("trial %d failed: %s", trial.number, reason)
                study.tell(trial, state=TrialState.FAIL)
            else:
                study.tell(trial, loss, state=TrialState.PRUNED if loss is None else TrialState.COMPLETE)

    def _loss(self, trial: optuna.Trial, transitions: Transitions, inputs: Sequence[Dataset]) -> float | None:
        """Train with values that Optuna suggests; return the validation loss, None where it was broken off."""
        space, seed = self.search.space, self.search.seed
        values = {name: found.suggest(trial, name, name in self.whole_numbers) for name, found in space.items()}
        config, recipe = self.search.configured(values)
        settings = {"model": config.model_dump(mode="json"), "recipe": recipe.model_dump(mode="json")}
        epochs = recipe.completed(config.learning_rate, config.steps, len(transitions.part("train"))).epochs or 1

        def report(_: int, number: int, epoch: Epoch) -> None:
            """Tell Optuna the loss after each tenth of the training: epochs differ in length with the batch size."""
            tenths = 10 * number // epochs
            if not epoch.finite or tenths == 10 * (number - 1) // epochs or number == epochs:
                return
            orientation_rad = math.radians(epoch.validation_orientation_deg)
            trial.report(epoch.validation_position_mm + recipe.heading_weight * orientation_rad, tenths)
            if trial.should_prune():
                raise optuna.TrialPruned

        name = f"{self.shared.name} trial {trial.number}"
        with tracked_run("dynamics", name, settings, inputs, seed) as tracked, quieter("swarmtwin.dynamics"):
            try:
                trained = train(
                    transitions, config, recipe, [seed], report=report, processes=1, device=self.search.device
                )
            except optuna.TrialPruned:
                tracked.tag("pruned", "true")
                return None
            best = trained.best.history[trained.best.best - 1]
            errors = {
                "validation_position_mm": best.validation_position_mm,
                "validation_orientation_deg": best.validation_orientation_deg,
            }
            tracked.metrics({**errors, "validation_loss": trained.best.validation_loss})
        for error, figure in errors.items():
            trial.set_user_attr(error, figure)
        return trained.best.validation_loss
