"""`swarmtwin train`: a dynamics model learns from transitions, is tracked and registered; a better one challenges."""

import shutil
import time
from collections.abc import Iterator
from contextlib import contextmanager, nullcontext
from pathlib import Path
from typing import Annotated, Any

from pydantic import Field
from rich.console import Console
from rich.table import Table

from swarmtwin.dynamics.error_plots import draw_training
from swarmtwin.dynamics.evaluation import one_step_errors
from swarmtwin.dynamics.model_config import ModelConfig, model_config
from swarmtwin.dynamics.provenance import Provenance
from swarmtwin.dynamics.trained_folder import TrainingData, provenance_of, save_trained
from swarmtwin.dynamics.training import Trained, train
from swarmtwin.files import CHECKPOINTS, new_folder, output_folder
from swarmtwin.learning.device import Device, torch_device
from swarmtwin.learning.progress_bars import training_bars
from swarmtwin.learning.recipe import Recipe
from swarmtwin.learning.trainer_settings import LiveCurves, TrainerSettings
from swarmtwin.robot import Robot, Seed, StrictModel
from swarmtwin.studies.tracked_inputs import split_inputs
from swarmtwin.tracking import registry
from swarmtwin.tracking.challengers import challenge_by_errors
from swarmtwin.tracking.gate import Errors
from swarmtwin.tracking.runs import TrackedRun, tracked_run
from swarmtwin.tracking.store import store_uri
from swarmtwin.transitions import SplitOptions
from swarmtwin.transitions.inputs import Vehicles, training_folder
from swarmtwin.transitions.source import TransitionSource


class Options(StrictModel):
    """Options of `swarmtwin train`; their defaults stand in conf/train.yaml."""

    robot: Robot
    model: dict[str, Any]
    recipe: Recipe
    trainer: TrainerSettings
    split: SplitOptions
    transitions: Path | None
    recording: Path | None
    vehicles: Vehicles
    synthetic: Path | None
    real_share: Annotated[float, Field(gt=0, lt=1)]
    device: Device
    seed: Seed
    seeds: Annotated[int, Field(ge=1)]
    register_model: Annotated[bool, Field(alias="register")]
    pictures: bool
    output: Path | None
    overwrite: bool


def run(options: Options) -> dict[str, Any]:
    """Train, save the model's folder, track the run and register the model; return its errors on validation runs.

    Raises:
        UserError: no usable transitions, an unknown model, every seed dead, or the output is taken.
    """
    config = model_config(options.model, "model")
    torch_device(options.device)
    source = training_folder(options.robot, options.transitions, options.recording, options.vehicles)
    name = f"{options.robot.name}-{config.name}"
    output = output_folder(options.output, "train", f"{name}-seed{options.seed}")
    settings = options.model_dump(mode="json", by_alias=True)
    folders = [folder for folder in (source, options.synthetic) if folder]
    with (
        new_folder(output, "train", settings, options.overwrite, resumable=True, inputs=folders) as folder,
        _workspace(folder) as workspace,
    ):
        data = TrainingData.read(
            options.robot,
            source,
            is_recording=options.recording is not None,
            vehicles=options.vehicles,
            split=options.split,
            synthetic=options.synthetic,
            real_share=options.real_share,
            workspace=workspace,
        )
        inputs = [each for of_folder in data.sources.items() for each in split_inputs(*of_folder)]
        with tracked_run("dynamics", name, settings, inputs, options.seed, options.trainer.system_metrics) as tracked:
            started = time.monotonic()
            curves = LiveCurves(tracked.run_id, store_uri()) if options.trainer.logger == "mlflow" else None
            trained = _train(options, config, data.transitions, folder / CHECKPOINTS, curves)
            provenance = provenance_of(trained, data.preparation)
            save_trained(folder, trained, provenance, data.evidence)
            if options.pictures:
                draw_training(folder, folder)
            seconds = time.monotonic() - started
            _track(tracked, trained, provenance, seconds)
            tracked.warnings(data.preparation.warnings)
            kept = tracked.model(folder, "dynamics")
            registered = "not registered"
            if options.register_model:
                registered = _register(tracked, trained, provenance, data.transitions, folder, kept)
    Console().print(_table(name, provenance))
    Console().print(f"{output}: {registered}", highlight=False, soft_wrap=True)
    return {**_errors(provenance), "training_s": round(seconds, 1), "output": str(output)}


@contextmanager
def _workspace(folder: Path) -> Iterator[Path]:
    """Give an empty folder as long as the block lasts, beside the checkpoints, which are no part of the output."""
    workspace = folder / CHECKPOINTS / "prepared"
    shutil.rmtree(workspace, ignore_errors=True)  # a killed call's
    workspace.mkdir(parents=True)
    try:
        yield workspace
    finally:
        shutil.rmtree(workspace, ignore_errors=True)


def _register(
    tracked: TrackedRun, trained: Trained, provenance: Provenance, data: TransitionSource, folder: Path, kept: str
) -> str:
    """Register the model, let it challenge the others by its errors on the validation runs, and say what came of it."""
    robot = trained.dynamics.robot
    tags = provenance.tags(trained.dynamics.config.name)
    version = registry.register(f"{robot.name}-dynamics", folder, kept, tracked.run_id, tags)
    validation = data.part("validation")
    errors = Errors.by_run(one_step_errors(trained.dynamics, validation), validation.run)
    return challenge_by_errors(tracked, version, errors, validation.digest())


def _train(
    options: Options, config: ModelConfig, transitions: TransitionSource, checkpoints: Path, curves: LiveCurves | None
) -> Trained:
    seeds = range(options.seed, options.seed + options.seeds)
    rows = transitions.count("train")
    epochs = options.recipe.completed(config.learning_rate, config.steps, rows).epochs or 0
    shown = options.trainer.progress_bar == "epochs"
    with training_bars(f"{options.robot.name} {config.name}", epochs) if shown else nullcontext() as report:
        spare = max(len(seeds), 4)  # that take the place of dead ones: of four, one lives, or the recipe is at fault
        return train(
            transitions,
            config,
            options.recipe,
            seeds,
            checkpoints,
            report,
            reserve=spare,
            device=options.device,
            trainer=options.trainer,
            curves=curves,
        )


def _track(tracked: TrackedRun, trained: Trained, provenance: Provenance, seconds: float) -> None:
    tracked.metrics(_errors(provenance))
    tracked.metrics({"training_s": seconds, "dead_seeds": len(trained.dead_seeds)})
    tracked.history((number, epoch._asdict()) for number, epoch in enumerate(trained.best.history, start=1))
    tracked.tag("recording", provenance.recording)
    tracked.tag("recording.digest", provenance.digest)
    tracked.tag("origin", provenance.origin)
    if provenance.generator:
        tracked.tag("generator.digest", provenance.generator.digest)


def _errors(provenance: Provenance) -> dict[str, float]:
    return {f"validation_{name}": error for name, error in provenance.chosen.errors.items()}


def _table(name: str, provenance: Provenance) -> Table:
    table = Table("seed", "position mm", "orientation °", "best epoch", "", title=f"{name}: errors on validation runs")
    for outcome in provenance.seeds:
        remark = f"dead: {outcome.dead}" if outcome.dead else "the model" if outcome.seed == provenance.seed else ""
        errors = [f"{error:.2f}" for error in outcome.errors.values()] or ["", ""]
        table.add_row(str(outcome.seed), *errors, str(outcome.best_epoch), remark)
    for column in table.columns[:4]:
        column.justify = "right"
    return table
