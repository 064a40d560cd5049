"""`swarmtwin tune`: hyper-parameters searched with Optuna, by several processes on one study."""

from pathlib import Path
from typing import Annotated, Any

import optuna
import yaml
from pydantic import Field
from rich.console import Console
from rich.table import Table

from swarmtwin.errors import UserError
from swarmtwin.files import write_text
from swarmtwin.learning.device import Device
from swarmtwin.learning.tuning import Range, complete_trials
from swarmtwin.robot import Robot, Seed, StrictModel
from swarmtwin.studies.hyperparameter_search import HyperparameterSearch
from swarmtwin.transitions import SplitOptions
from swarmtwin.transitions.inputs import Vehicles


class Options(StrictModel):
    """Options of `swarmtwin tune`; their defaults stand in conf/tune.yaml."""

    robot: Robot
    model: dict[str, Any]
    recipe: dict[str, Any]
    space: Annotated[dict[str, Range], Field(min_length=1)]
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


def run(options: Options) -> None:
    """Search until the study holds as many trials as asked for; show the best.

    Raises:
        UserError: an option of the space does not exist, the data or the storage are at fault, the study was made for
            something else, or no trial gave a loss.
    """
    search = HyperparameterSearch(**{name: getattr(options, name) for name in HyperparameterSearch.model_fields})
    study = search.run(options.study, options.storage, options.trials, options.workers)
    if not complete_trials(study):
        raise UserError(f"study {study.study_name!r}: no trial finished: widen or shift the space")
    best = Path("outputs/tune") / f"{study.study_name}.yaml"
    best.parent.mkdir(parents=True, exist_ok=True)
    write_text(best, yaml.safe_dump({"loss": study.best_value, **study.best_params}, sort_keys=False))
    found = " ".join(f"{name}={_text(value)}" for name, value in study.best_params.items())
    chosen = f"robot={options.robot.name} model={options.model['name']} {found}"
    Console().print(_table(study))
    Console().print(f"train with it: swarmtwin train {chosen}", highlight=False)
    Console().print(f"best values: {best}", highlight=False)


def _text(value: Any) -> str:
    return f"{value:.4g}" if isinstance(value, float) else str(value)


def _table(study: optuna.Study) -> Table:
    ranked = sorted(complete_trials(study), key=lambda trial: trial.value or 0)
    names = list(ranked[0].params)
    table = Table(
        "trial", "loss", "position mm", "orientation °", *names, title=f"study {study.study_name}: best trials"
    )
    for trial in ranked[:10]:
        errors = [trial.user_attrs[f"validation_{error}"] for error in ("position_mm", "orientation_deg")]
        values = [trial.params[name] for name in names]
        table.add_row(str(trial.number), *map(_text, [trial.value, *errors, *values]))
    return table
