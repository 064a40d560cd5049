"""`swarmtwin tune`: hyper-parameters searched with Optuna, by several processes on one study."""

import logging
import multiprocessing
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from functools import partial
from multiprocessing.synchronize import Semaphore
from pathlib import Path
from typing import Annotated, Any

import numpy as np
import optuna
import yaml
from optuna.trial import TrialState
from pydantic import Field
from rich.console import Console
from rich.table import Table

from swarmtwin.commands.search_space import Range
from swarmtwin.commands.shared_study import SharedStudy, complete_trials, identity, trials_done
from swarmtwin.commands.sources import Vehicles, training_transitions
from swarmtwin.commands.workers import work_side_by_side
from swarmtwin.dynamics.model_config import ModelConfig
from swarmtwin.dynamics.recipe import Recipe
from swarmtwin.dynamics.registry import model_config
from swarmtwin.dynamics.training import train
from swarmtwin.errors import UserError, near_miss
from swarmtwin.files import write_text
from swarmtwin.robot import Robot, Seed, StrictModel
from swarmtwin.tracking import parent_run, tracked_run
from swarmtwin.transitions import Preparation, SplitOptions, Transitions

logger = logging.getLogger(__name__)

MOST_TRIALS = 100_000
MOST_WORKERS = 256


class Options(StrictModel):
    """Options of `swarmtwin tune`; their defaults stand in conf/tune.yaml."""

    robot: Robot
    model: dict[str, Any]
    recipe: dict[str, Any]
    space: Annotated[dict[str, Range], Field(min_length=1)]
    trials: Annotated[int, Field(ge=1, le=MOST_TRIALS)]
    workers: Annotated[int, Field(ge=1, le=MOST_WORKERS)]
    split: SplitOptions
    transitions: Path | None
    recording: Path | None
    vehicles: Vehicles
    seed: Seed
    study: str | None
    storage: str | None


def run(options: Options) -> None:
    """Search until the study holds as many trials as asked for; show the best.

    Raises:
        UserError: an option of the space does not exist, the data or the storage are at fault, the study was made for
            something else, or no trial gave a loss.
    """
    whole = _check(options)
    transitions, preparation, _ = _data(options)
    shared = SharedStudy.named(
        options.study,
        f"{options.robot.name}-{options.model['name']}",
        options.storage,
        _made_for(options, transitions.robot, preparation),
    )
    study = shared.open()
    done, begun = trials_done(study), len(study.get_trials(deepcopy=False))
    logger.info("study %s in %s: %d trials there, %d asked for", shared.name, shared.place, done, options.trials)
    if done < options.trials:
        budget = multiprocessing.get_context("spawn").Semaphore(options.trials - done)
        searches = [(options, shared, whole, budget, (begun, number)) for number in range(options.workers)]
        with parent_run("dynamics", f"tune {shared.name}", "study"):
            if options.workers == 1:
                _search(*searches[0])
            else:
                work_side_by_side(_search, searches)
    if not complete_trials(study):
        raise UserError(f"study {shared.name!r}: no trial finished: widen or shift the space")
    best = Path("outputs/tune") / f"{shared.name}.yaml"
    best.parent.mkdir(parents=True, exist_ok=True)
    write_text(best, yaml.safe_dump({"loss": study.best_value, **study.best_params}, sort_keys=False))
    Console().print(_table(study))
    Console().print(f"train with it: swarmtwin train {_overrides(options, study.best_params)}", highlight=False)
    Console().print(f"best values: {best}", highlight=False)


def _check(options: Options) -> frozenset[str]:
    """Refuse a space whose options do not exist or refuse its values; return those that take whole numbers alone."""
    known = [f"{group}.{field}" for group in ("model", "recipe") for field in getattr(options, group)]
    for name in options.space:
        if name not in known:
            raise UserError(f"space: no option {name!r}: {near_miss(name, known)}")
    _configured(options, {})
    whole = set()
    for name, found in options.space.items():
        try:
            if found.takes_whole_numbers(name, partial(_with_value, options, name)):
                whole.add(name)
        except UserError as error:
            raise UserError(f"space: {error}") from None
    return frozenset(whole)


def _with_value(options: Options, name: str, value: Any) -> tuple[ModelConfig, Recipe]:
    return _configured(options, {name: value})


def _configured(options: Options, values: Mapping[str, Any]) -> tuple[ModelConfig, Recipe]:
    """Return model and recipe with the values of a trial put in."""
    groups = {"model": dict(options.model), "recipe": dict(options.recipe)}
    for name, value in values.items():
        group, field = name.split(".", 1)
        groups[group][field] = value
    return model_config(groups["model"], "model"), Recipe.parse(groups["recipe"], "recipe")


def _data(options: Options) -> tuple[Transitions, Preparation, Path]:
    return training_transitions(options.robot, options.transitions, options.recording, options.vehicles, options.split)


def _made_for(options: Options, robot: Robot, preparation: Preparation) -> dict[str, str]:
    """Identify what the trials of a study have in common: everything but the values searched, and the seed."""
    config, recipe = _configured(options, {})
    groups = {"model": config.model_dump(mode="json"), "recipe": recipe.model_dump(mode="json")}
    for name in options.space:
        group, field = name.split(".", 1)
        del groups[group][field]
    return identity(
        {
            "robot": robot.model_dump(mode="json"),
            **groups,
            "space": {name: found.model_dump(mode="json") for name, found in options.space.items()},
            "data": [preparation.digest, preparation.vehicles],
            "split": preparation.model_dump(mode="json", include={"fractions", "seed"}),
        }
    )


def _search(
    options: Options, shared: SharedStudy, whole: frozenset[str], budget: Semaphore, draw: tuple[int, int]
) -> None:
    """Add trials to the study, each for one unit of the `budget`; `draw` makes the sampler's numbers its own."""
    transitions, _, source = _data(options)
    seed = int(np.random.SeedSequence([options.seed, *draw]).generate_state(1)[0])
    study = shared.open(optuna.samplers.TPESampler(seed=seed, constant_liar=options.workers > 1))
    while trials_done(study) < options.trials and budget.acquire(block=False):
        trial = study.ask()
        try:
            values = {name: found.suggest(trial, name, name in whole) for name, found in options.space.items()}
            loss = _loss(options, transitions, source, trial, f"{shared.name} trial {trial.number}", values)
        except (UserError, RuntimeError, MemoryError) as error:
            reason = (str(error).strip().splitlines() or ["out of memory"])[0]
            logger.warning("trial %d failed: %s", trial.number, reason)
            study.tell(trial, state=TrialState.FAIL)
        else:
            study.tell(trial, loss)


def _loss(
    options: Options,
    transitions: Transitions,
    source: Path,
    trial: optuna.Trial,
    name: str,
    values: Mapping[str, Any],
) -> float:
    """Train with the values of a trial; return the validation loss."""
    config, recipe = _configured(options, values)
    settings = {"model": config.model_dump(mode="json"), "recipe": recipe.model_dump(mode="json")}
    with tracked_run("dynamics", name, settings, [source], options.seed) as tracked, _no_warnings():
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


@contextmanager
def _no_warnings() -> Iterator[None]:
    """Keep trainings from telling what the one line about their trial tells."""
    training = logging.getLogger("swarmtwin.dynamics")
    level = training.level
    training.setLevel(logging.ERROR)
    try:
        yield
    finally:
        training.setLevel(level)


def _overrides(options: Options, values: Mapping[str, Any]) -> str:
    chosen = " ".join(
        f"{name}={value:.4g}" if isinstance(value, float) else f"{name}={value}" for name, value in values.items()
    )
    return f"robot={options.robot.name} model={options.model['name']} {chosen}"


def _table(study: optuna.Study) -> Table:
    ranked = sorted(complete_trials(study), key=lambda trial: trial.value or 0)
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
