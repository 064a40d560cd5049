"""`swarmtwin tune`: hyper-parameters searched with Optuna, by several processes on one study."""

import logging
import multiprocessing
from collections.abc import Mapping
from pathlib import Path
from typing import Annotated, Any, Self

import optuna
import yaml
from optuna.storages.journal import JournalFileBackend
from optuna.trial import TrialState
from pydantic import Field, model_validator
from rich.console import Console
from rich.table import Table

from swarmtwin.commands.sources import Vehicles, training_transitions
from swarmtwin.dynamics.recipe import Recipe
from swarmtwin.dynamics.registry import model_config
from swarmtwin.dynamics.training import train
from swarmtwin.errors import UserError, near_miss
from swarmtwin.files import write_text
from swarmtwin.robot import Robot, StrictModel
from swarmtwin.tracking import parent_run, tracked_run
from swarmtwin.transitions import SplitOptions

logger = logging.getLogger(__name__)

COUNTED = (TrialState.COMPLETE, TrialState.RUNNING)


class Range(StrictModel):
    """Where to search one option: between two numbers, or among choices."""

    low: float | None = None
    high: float | None = None
    log: bool = False
    choices: tuple[bool | int | float | str, ...] | None = None

    @model_validator(mode="after")
    def _one_of_both(self) -> Self:
        if (self.choices is None) == (self.low is None or self.high is None):
            raise ValueError("give low and high, or choices")
        return self

    def suggest(self, trial: optuna.Trial, name: str) -> Any:
        """Let Optuna choose a value."""
        if self.choices is not None:
            return trial.suggest_categorical(name, self.choices)
        assert self.low is not None
        assert self.high is not None
        if float(self.low).is_integer() and float(self.high).is_integer():
            return trial.suggest_int(name, int(self.low), int(self.high), log=self.log)
        return trial.suggest_float(name, self.low, self.high, log=self.log)


class Options(StrictModel):
    """Options of `swarmtwin tune`; their defaults stand in conf/tune.yaml."""

    robot: Robot
    model: dict[str, Any]
    recipe: dict[str, Any]
    space: Annotated[dict[str, Range], Field(min_length=1)]
    trials: Annotated[int, Field(ge=1)]
    workers: Annotated[int, Field(ge=1)]
    split: SplitOptions
    transitions: Path | None
    recording: Path | None
    vehicles: Vehicles
    seed: int
    study: str | None
    storage: str | None

    @property
    def study_name(self) -> str:
        """The study's name."""
        return self.study or f"{self.robot.name}-{self.model.get('name')}"

    @property
    def storage_place(self) -> str:
        """The journal file or database that processes share."""
        return self.storage or f"outputs/tune/{self.study_name}.journal"


def run(options: Options) -> None:
    """Search until the study holds as many trials as asked for; show the best.

    Raises:
        UserError: an option of the space does not exist, the data are at fault, or no trial finished.
    """
    optuna.logging.set_verbosity(optuna.logging.WARNING)
    _check(options)
    training_transitions(options.robot, options.transitions, options.recording, options.vehicles, options.split)
    study = _study(options)
    done = len(_finished(study))
    logger.info(
        "study %s in %s: %d trials there, %d asked for", study.study_name, options.storage_place, done, options.trials
    )
    with parent_run("dynamics", f"tune {options.study_name}", "study"):
        _work(options)
    if not _finished(study):
        raise UserError(f"study {options.study_name!r}: no trial finished: widen or shift the space")
    best = Path("outputs/tune") / f"{options.study_name}.yaml"
    best.parent.mkdir(parents=True, exist_ok=True)
    write_text(best, yaml.safe_dump({"loss": study.best_value, **study.best_params}, sort_keys=False))
    Console().print(_table(study))
    Console().print(f"train with it: swarmtwin train {_overrides(options, study.best_params)}", highlight=False)
    Console().print(f"best values: {best}", highlight=False)


def _check(options: Options) -> None:
    """Refuse a space whose options do not exist, before anything is trained."""
    known = [f"{group}.{field}" for group in ("model", "recipe") for field in getattr(options, group)]
    for name in options.space:
        if name not in known:
            raise UserError(f"space: no option {name!r}: {near_miss(name, known)}")
    _configured(options, {name: getattr(options, g)[f] for name in options.space for g, f in [name.split(".", 1)]})


def _configured(options: Options, values: Mapping[str, Any]) -> tuple[Any, Recipe]:
    """Return model and recipe with the values of a trial put in."""
    groups = {"model": dict(options.model), "recipe": dict(options.recipe)}
    for name, value in values.items():
        group, field = name.split(".", 1)
        groups[group][field] = value
    return model_config(groups["model"], "model"), Recipe.parse(groups["recipe"], "recipe")


def _study(options: Options) -> optuna.Study:
    place = options.storage_place
    storage: Any = place
    if "://" not in place:
        Path(place).parent.mkdir(parents=True, exist_ok=True)
        storage = optuna.storages.JournalStorage(JournalFileBackend(place))
    sampler = optuna.samplers.TPESampler(seed=options.seed, constant_liar=options.workers > 1)
    return optuna.create_study(
        storage=storage, study_name=options.study_name, sampler=sampler, direction="minimize", load_if_exists=True
    )


def _work(options: Options) -> None:
    if options.workers == 1:
        _search(options, 0)
        return
    context = multiprocessing.get_context("spawn")
    workers = [context.Process(target=_search, args=(options, number)) for number in range(options.workers)]
    try:
        for worker in workers:
            worker.start()
        for worker in workers:
            worker.join()
    finally:
        for worker in workers:
            worker.terminate()
    if all(worker.exitcode for worker in workers):
        raise UserError(f"study {options.study_name!r}: every worker failed, see above")


def _search(options: Options, number: int) -> None:
    """Add trials until the study is complete; one of several processes."""
    optuna.logging.set_verbosity(optuna.logging.WARNING)
    options = options.model_copy(update={"seed": options.seed + number})
    transitions, _, source = training_transitions(
        options.robot, options.transitions, options.recording, options.vehicles, options.split
    )

    def objective(trial: optuna.Trial) -> float:
        _claim(trial, options.trials)
        values = {name: found.suggest(trial, name) for name, found in options.space.items()}
        config, recipe = _configured(options, values)
        settings = {"model": config.model_dump(mode="json"), "recipe": recipe.model_dump(mode="json")}
        name = f"{options.study_name} trial {trial.number}"
        with tracked_run("dynamics", name, settings, [source], options.seed) as tracked:
            trained = train(transitions, config, recipe, [options.seed], processes=1)
            best = trained.best.history[trained.best.best - 1]
            errors = {
                "validation_position_mm": best.validation_position_mm,
                "validation_orientation_deg": best.validation_orientation_deg,
            }
            tracked.metrics({**errors, "validation_loss": trained.best.validation_loss})
        for error, figure in errors.items():
            trial.set_user_attr(error, figure)
        return trained.best.validation_loss

    study = _study(options)
    failed_before = len(study.get_trials(states=[TrialState.FAIL]))

    def stop_when_complete(study: optuna.Study, trial: optuna.trial.FrozenTrial) -> None:
        """Stop at as many trials as asked for, finished or under way; or at as many failures: more would fail too."""
        failed = len(study.get_trials(states=[TrialState.FAIL])) - failed_before
        if max(len(study.get_trials(states=COUNTED)), failed) >= options.trials:
            study.stop()

    if len(_finished(study)) < options.trials:
        study.optimize(objective, callbacks=[stop_when_complete], catch=(UserError,))


def _claim(trial: optuna.Trial, trials: int) -> None:
    """Give a trial up that another process's, started at the same moment, makes one too many."""
    ahead = [other for other in trial.study.get_trials(states=COUNTED) if other.number < trial.number]
    if len(ahead) >= trials:
        trial.study.stop()
        raise optuna.TrialPruned


def _finished(study: optuna.Study) -> list[optuna.trial.FrozenTrial]:
    return study.get_trials(states=[TrialState.COMPLETE])


def _overrides(options: Options, values: Mapping[str, Any]) -> str:
    chosen = " ".join(
        f"{name}={value:.4g}" if isinstance(value, float) else f"{name}={value}" for name, value in values.items()
    )
    return f"robot={options.robot.name} model={options.model['name']} {chosen}"


def _table(study: optuna.Study) -> Table:
    ranked = sorted(_finished(study), key=lambda trial: trial.value or 0)
    names = list(ranked[0].params)
    table = Table(
        "trial", "loss", "position mm", "orientation °", *names, title=f"study {study.study_name}: best trials"
    )
    for trial in ranked[:10]:
        errors = [trial.user_attrs[f"validation_{error}"] for error in ("position_mm", "orientation_deg")]
        values = [trial.params[name] for name in names]
        shown = [
            f"{value:.4g}" if isinstance(value, float) else str(value) for value in [trial.value, *errors, *values]
        ]
        table.add_row(str(trial.number), *shown)
    return table
