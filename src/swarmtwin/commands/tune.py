"""`swarmtwin tune`: hyper-parameters of a dynamics model or a generator, by several processes on one Optuna study."""

import shlex
from collections.abc import Mapping
from pathlib import Path
from typing import Annotated, Any, Literal

import optuna
import yaml
from hydra.core.hydra_config import HydraConfig
from optuna.trial import TrialState
from pydantic import Field
from rich import box
from rich.console import Console
from rich.table import Table

from swarmtwin.errors import UserError, near_miss
from swarmtwin.files import write_text
from swarmtwin.learning.device import Device
from swarmtwin.learning.tuning import Range, complete_trials
from swarmtwin.robot import Robot, Seed, StrictModel
from swarmtwin.studies.dynamics_search import DynamicsSearch
from swarmtwin.studies.found_values import configuration_word
from swarmtwin.studies.generator_search import GeneratorSearch
from swarmtwin.studies.hyperparameter_search import HyperparameterSearch
from swarmtwin.transitions import SplitOptions
from swarmtwin.transitions.inputs import Vehicles


class Options(StrictModel):
    """Options of `swarmtwin tune`; their defaults stand in conf/tune.yaml."""

    robot: Robot
    what: Literal["dynamics", "generator"]
    model: dict[str, Any]
    recipe: dict[str, Any]
    generator: dict[str, Any]
    space: Annotated[dict[str, Range], Field(min_length=1)]
    generator_space: dict[str, Annotated[dict[str, Range], Field(min_length=1)]]
    trials: Annotated[int, Field(ge=1, le=100_000)]
    workers: Annotated[int, Field(ge=1, le=256)]
    split: SplitOptions
    transitions: Path | None
    recording: Path | None
    vehicles: Vehicles
    device: Device
    seed: Seed
    study: str | None
    storage: str | None
    prune: bool

    def search(self) -> HyperparameterSearch:
        """Return what is searched.

        Raises:
            UserError: nobody says what to search of this generator.
        """
        kind = DynamicsSearch if self.what == "dynamics" else GeneratorSearch
        given = {name: getattr(self, name) for name in kind.model_fields}
        if self.what == "generator":
            name = str(self.generator.get("name"))
            if name not in self.generator_space:
                known = near_miss(name, self.generator_space)
                raise UserError(
                    f"generator_space has no entry {name!r}: {known}; add what to search of it, "
                    f"'+generator_space.{name}={{generator.OPTION: {{low: ..., high: ...}}}}'"
                )
            given["space"] = self.generator_space[name]
        return kind(**given)


def run(options: Options) -> dict[str, Any]:
    """Search until the study holds as many trials as asked for; show the best, and return it.

    Raises:
        UserError: an option of the space does not exist, the data or the storage are at fault, the study was made for
            something else, or no trial gave a loss.
    """
    search, folder = options.search(), Path("outputs/tune")
    study = search.run(options.study, options.storage, options.trials, options.workers, folder)
    if not complete_trials(study):
        raise UserError(f"study {study.study_name!r}: no trial finished: widen or shift the space")
    best = folder / f"{study.study_name}.yaml"
    write_text(best, yaml.safe_dump({"loss": study.best_value, **study.best_params}, sort_keys=False))
    Console().print(_table(study, search.headings))
    command = ["swarmtwin", "train" if options.what == "dynamics" else "generate"]
    given = _given_options(options, search)
    for title, words in (
        ("train with it", [*command, *_with_values(given, study.best_params)]),
        ("as configurations", [*command, *_with_configurations(given, folder / study.study_name, study)]),
        ("best values", [str(best)]),
    ):
        Console().print(f"{title}: {shlex.join(words)}", highlight=False, soft_wrap=True)
    return {"loss": study.best_value, **study.best_trial.user_attrs, "trials": len(study.trials), "output": str(best)}


def _given_options(options: Options, search: HyperparameterSearch) -> dict[str, str]:
    """Return the options that this call was given and `train` or `generate` takes as well, by name."""
    given, kept = [], {}
    own = {"what", "space", "generator_space", "trials", "workers", "prune", "study", "storage"}
    own |= {"model", "recipe", "generator"} - search.options.keys()
    if HydraConfig.initialized():
        given = list(HydraConfig.get().overrides.task)
        sources = HydraConfig.get().runtime.config_sources
        kept = {one.path: f"--config-dir={one.path}" for one in sources if one.provider == "command-line"}
    for option in given:
        name = option.partition("=")[0].lstrip("+~")
        if name.split(".")[0] not in own:
            kept[name] = option
    group = next(iter(search.options))
    return {"robot": f"robot={options.robot.name}", group: f"{group}={search.learner}"} | kept


def _with_values(given: Mapping[str, str], found: Mapping[str, Any]) -> list[str]:
    """Return the options with the values found, those with dashes first, as they must stand."""
    kept = [option for name, option in given.items() if name not in found]
    return [*sorted(kept, key=lambda option: option[:2] != "--"), *(f"{name}={value}" for name, value in found.items())]


def _with_configurations(given: Mapping[str, str], folder: Path, study: optuna.Study) -> list[str]:
    """Return the options with the configurations found in place of what they were made from."""
    groups = sorted({name.partition(".")[0] for name in study.best_params})
    kept = [option for name, option in given.items() if name.split(".")[0] not in groups and option[:2] != "--"]
    word = configuration_word(study.study_name)
    return [f"--config-dir={folder}", *kept, *(f"{group}={word}" for group in groups)]


def _text(value: Any) -> str:
    return f"{value:.4g}" if isinstance(value, float) else str(value)


def _table(study: optuna.Study, headings: Mapping[str, str]) -> Table:
    ranked = sorted(complete_trials(study), key=lambda trial: trial.value or 0)
    names = list(ranked[0].params)
    table = Table(
        title=f"study {study.study_name}: best trials", box=box.SIMPLE_HEAD, padding=(0, 1, 0, 0), pad_edge=False
    )
    for heading in ("trial", "loss", *headings.values(), *(name.replace(".", ".\n") for name in names)):
        table.add_column(heading, justify="right", overflow="fold")
    for trial in ranked[:10]:
        errors = [trial.user_attrs[name] for name in headings]
        values = [trial.params[name] for name in names]
        table.add_row(str(trial.number), *map(_text, [trial.value, *errors, *values]))
    broken_off = len(study.get_trials(deepcopy=False, states=[TrialState.PRUNED]))
    table.caption = (
        f"of {len(study.trials)} trials, {broken_off} broken off early; errors on validation runs; "
        f"each trial's run in MLflow: {study.study_name} trial N"
    )
    return table
