"""A search for hyper-parameters of what learns: trials of one Optuna study, trained side by side."""

import logging
import math
from abc import abstractmethod
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any, ClassVar, NamedTuple

import numpy as np
import optuna
from optuna.trial import TrialState

from swarmtwin.errors import UserError, near_miss
from swarmtwin.learning.device import Device
from swarmtwin.learning.parallel import Report, run_side_by_side
from swarmtwin.learning.progress_bars import quieter
from swarmtwin.learning.tuning import Range, SharedStudy, complete_trials, identity, trials_done
from swarmtwin.robot import Robot, Seed, StrictModel
from swarmtwin.studies.found_values import save_found
from swarmtwin.studies.tracked_inputs import split_inputs
from swarmtwin.tracking.datasets import Dataset
from swarmtwin.tracking.runs import Experiment, TrackedRun, close_orphans, keep_folder, parent_run, tracked_run
from swarmtwin.transitions import Preparation, SplitOptions, Transitions
from swarmtwin.transitions.inputs import Vehicles, training_transitions

logger = logging.getLogger(__name__)

LossReport = Callable[[int, int, float], None]
"""Told how much of a training is done, of how much, and the loss by then; it breaks hopeless trainings off."""


class Outcome(NamedTuple):
    """What a trial came to: its loss on the validation runs, and figures by name."""

    loss: float
    figures: dict[str, float]


class HyperparameterSearch(StrictModel):
    """What is searched: where each option may lie, and all that stays the same. Each kind of learner has its own.

    Attributes:
        robot: whose motion is learned.
        space: the options searched, such as `recipe.learning_rate`.
        split: of a recording by runs.
        transitions: the folder to learn from, or
        recording: the recording to learn from.
        vehicles: of the recording, None for all.
        device: where it is trained.
        seed: of the sampler and of each training.
        prune: whether a trial is broken off that, a tenth of its training after the other, is worse than half of the
            others were there.
    """

    experiment: ClassVar[Experiment]
    """Of MLflow, where the trials are kept."""
    headings: ClassVar[Mapping[str, str]]
    """What tables call the figures of an outcome, by their names."""

    robot: Robot
    space: dict[str, Range]
    split: SplitOptions
    transitions: Path | None
    recording: Path | None
    vehicles: Vehicles
    device: Device
    seed: Seed
    prune: bool

    @property
    @abstractmethod
    def options(self) -> dict[str, dict[str, Any]]:
        """The options that can be searched, by the group of `conf/` that they stand in; the first names the learner."""

    @abstractmethod
    def parsed(self, options: Mapping[str, dict[str, Any]]) -> dict[str, StrictModel]:
        """Return the typed configuration of each group.

        Raises:
            UserError: an option does not exist, or refuses its value.
        """

    @abstractmethod
    def trained(
        self,
        configs: Mapping[str, StrictModel],
        transitions: Transitions,
        preparation: Preparation,
        report: LossReport,
    ) -> Outcome:
        """Train by these configurations.

        Raises:
            UserError: the training came to nothing.
            optuna.TrialPruned: `report` broke it off.
        """

    @property
    def learner(self) -> str:
        """The name of what learns, as its configuration states it."""
        return str(next(iter(self.options.values()))["name"])

    def run(self, name: str | None, storage: str | None, trials: int, workers: int, folder: Path) -> optuna.Study:
        """Search until the study holds as many trials as asked for, and return it.

        What was found is written into a folder with the study's name: configurations, and pictures of the search.

        Args:
            name: of the study; None: one made of what it is for.
            storage: a database's URL or a journal file; None: an SQLite file under outputs/tune.
            trials: that end, well or badly, those of former calls among them.
            workers: processes that work on them.
            folder: the parent of that folder.

        Raises:
            UserError: an option of the space does not exist, the data or the storage are at fault, or the study was
                made for something else.
        """
        whole_numbers = self._check_space()
        transitions, preparation, _ = self.data()
        made_for = self._made_for(transitions.robot, preparation)
        shared = SharedStudy.named(name, f"{self.robot.name}-{self.learner}", storage, made_for)
        study = shared.open()
        done = trials_done(study)
        logger.info("study %s in %s: %d trials there, %d asked for", shared.name, shared.place, done, trials)
        shares = [len(range(number, trials - done, workers)) for number in range(workers)]
        jobs = [
            _Worker(self, shared, whole_numbers, share, number, alone=workers == 1)
            for number, share in enumerate(shares)
            if share
        ]
        found = folder / shared.name
        if not jobs:
            close_orphans(self.experiment)
            self._save(found, study, preparation)
            return study
        with parent_run(self.experiment, f"tune {shared.name}", "study") as run_id:
            run_side_by_side(jobs, None, len(jobs))
            if self._save(found, study, preparation):
                TrackedRun(run_id).metrics({"best_loss": study.best_value})
                keep_folder(run_id, found, "study")
        return study

    def data(self) -> tuple[Transitions, Preparation, Path]:
        """Return what is learned from, how it came about, and the folder that it comes from."""
        return training_transitions(self.robot, self.transitions, self.recording, self.vehicles, self.split)

    def configured(self, values: Mapping[str, Any]) -> dict[str, StrictModel]:
        """Return the configuration of each group with the values of a trial put in.

        Raises:
            UserError: an option refuses its value.
        """
        return self.parsed(self.with_values(values))

    def with_values(self, values: Mapping[str, Any]) -> dict[str, dict[str, Any]]:
        """Return the options of each group with the values of a trial put in, not checked."""
        groups = {group: dict(options) for group, options in self.options.items()}
        for name, value in values.items():
            group, field = name.split(".", 1)
            groups[group][field] = value
        return groups

    def _save(self, folder: Path, study: optuna.Study, preparation: Preparation) -> bool:
        """Write what was found, if anything was."""
        if not complete_trials(study):
            return False
        save_found(folder, study, self.with_values(study.best_params), self.space, preparation)
        return True

    def _check_space(self) -> frozenset[str]:
        """Refuse a space whose options do not exist or refuse its values; return those that take whole numbers."""
        known = [f"{group}.{field}" for group, options in self.options.items() for field in options]
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

    def _configured_with(self, name: str, value: Any) -> dict[str, StrictModel]:
        return self.configured({name: value})

    def _made_for(self, robot: Robot, preparation: Preparation) -> dict[str, str]:
        """Identify what the trials of a study have in common: everything but the values searched, and the seed."""
        groups = {group: config.model_dump(mode="json") for group, config in self.configured({}).items()}
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


class _Pruning:
    """Tells Optuna the loss after each tenth of a training: what is reported differs in length from trial to trial."""

    def __init__(self, trial: optuna.Trial) -> None:
        self.trial = trial
        self.tenths = 0

    def __call__(self, done: int, of: int, loss: float) -> None:
        """Break the trial off where Optuna says so; what is done is not reported any more.

        Raises:
            optuna.TrialPruned: it is broken off.
        """
        tenths = 10 * done // of
        if not math.isfinite(loss) or tenths == self.tenths or done >= of:
            return
        self.tenths = tenths
        self.trial.report(loss, tenths)
        if self.trial.should_prune():
            raise optuna.TrialPruned


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
        transitions, preparation, source = self.search.data()
        inputs = split_inputs(source, transitions, ("train", "validation"))
        study = self.shared.open()
        pruner = optuna.pruners.MedianPruner(n_startup_trials=10, n_warmup_steps=1)
        study.pruner = pruner if self.search.prune else optuna.pruners.NopPruner()
        for _ in range(self.trials):
            study.sampler = self._sampler(study)
            trial = study.ask()
            try:
                loss = self._loss(trial, transitions, preparation, inputs)
            except (UserError, RuntimeError, MemoryError) as error:
                reason = (str(error).strip().splitlines() or ["out of memory"])[0]
                logger.warning("trial %d failed: %s", trial.number, reason)
                study.tell(trial, state=TrialState.FAIL)
            else:
                study.tell(trial, loss, state=TrialState.PRUNED if loss is None else TrialState.COMPLETE)

    def _loss(
        self, trial: optuna.Trial, transitions: Transitions, preparation: Preparation, inputs: Sequence[Dataset]
    ) -> float | None:
        """Train with values that Optuna suggests; return the validation loss, None where it was broken off."""
        search = self.search
        values = {name: found.suggest(trial, name, name in self.whole_numbers) for name, found in search.space.items()}
        configs = search.configured(values)
        settings = {group: config.model_dump(mode="json") for group, config in configs.items()}
        name = f"{self.shared.name} trial {trial.number}"
        with (
            tracked_run(search.experiment, name, settings, inputs, search.seed) as tracked,
            quieter("swarmtwin.dynamics"),
        ):
            try:
                outcome = search.trained(configs, transitions, preparation, _Pruning(trial))
            except optuna.TrialPruned:
                tracked.tag("pruned", "true")
                return None
            tracked.metrics({**outcome.figures, "validation_loss": outcome.loss})
        for figure, value in outcome.figures.items():
            trial.set_user_attr(figure, value)
        return outcome.loss
