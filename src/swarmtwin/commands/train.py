"""`swarmtwin train`: a dynamics model learns from transitions, is tracked, and registered as challenger."""

import json
import shutil
import time
from pathlib import Path
from typing import Annotated, Any

import pandas as pd
from pydantic import Field
from rich.console import Console
from rich.table import Table

from swarmtwin import registry
from swarmtwin.commands.outputs import output_folder
from swarmtwin.commands.progress import training_bars
from swarmtwin.commands.sources import Vehicles, prepared_transitions, training_transitions
from swarmtwin.dynamics.figures import history_figure
from swarmtwin.dynamics.model_config import ModelConfig
from swarmtwin.dynamics.provenance import Provenance, SeedOutcome
from swarmtwin.dynamics.recipe import Recipe
from swarmtwin.dynamics.registry import model_config
from swarmtwin.dynamics.store import save_dynamics, save_evidence
from swarmtwin.dynamics.training import Trained, train
from swarmtwin.files import check_output, new_folder, write_text
from swarmtwin.robot import Robot, Seed, StrictModel
from swarmtwin.tracking import TrackedRun, tracked_run
from swarmtwin.transitions import Preparation, SplitOptions, Transitions, held_out, mix
from swarmtwin.transitions.transitions import Split

CHECKPOINTS = "checkpoints"
FEWEST_SPARE_SEEDS = 4
MOST_EVIDENCE = 20_000
UNFITTED: tuple[Split, ...] = ("validation", "test")
UNFITTED_BY_GENERATOR: tuple[Split, ...] = ("test",)
NONE: tuple[Split, ...] = ()


class Options(StrictModel):
    """Options of `swarmtwin train`; their defaults stand in conf/train.yaml."""

    robot: Robot
    model: dict[str, Any]
    recipe: Recipe
    split: SplitOptions
    transitions: Path | None
    recording: Path | None
    vehicles: Vehicles
    synthetic: Path | None
    real_share: Annotated[float, Field(gt=0, lt=1)]
    seed: Seed
    seeds: Annotated[int, Field(ge=1)]
    register_model: Annotated[bool, Field(alias="register")]
    output: Path | None
    overwrite: bool


def run(options: Options) -> None:
    """Train, save the model's folder, track the run and register the model.

    Beside the model lies its evidence: real transitions that it was not fitted to, against which later sessions can be
    diagnosed (`load_evidence`). A mixture's is the test split alone, since its generator may have seen the rest.

    Raises:
        UserError: no usable transitions, an unknown model, every seed dead, or the output is taken.
    """
    config = model_config(options.model, "model")
    transitions, preparation, evidence, sources = _transitions(options)
    name = f"{options.robot.name}-{config.name}"
    output = output_folder(options.output, "train", f"{name}-seed{options.seed}")
    settings = options.model_dump(mode="json", by_alias=True)
    check_output(output, "train", options.overwrite, sources)
    with tracked_run("dynamics", name, settings, sources, options.seed) as tracked:
        started = time.monotonic()
        with new_folder(output, "train", settings, options.overwrite, keep_partial=True, inputs=sources) as folder:
            trained = _train(options, config, transitions, folder / CHECKPOINTS)
            provenance = _provenance(trained, preparation)
            _save(folder, trained, provenance)
            if len(evidence):
                save_evidence(folder, evidence)
        _track(tracked, trained, provenance, time.monotonic() - started)
        kept = tracked.folder(output, "model")
        registered = "not registered"
        if options.register_model:
            registered_name = f"{options.robot.name}-dynamics"
            version = registry.register(registered_name, output, kept, tracked.run_id, provenance.tags(config.name))
            registered = f"registered as {version}, its challenger"
    Console().print(_table(name, provenance))
    Console().print(f"{output}: {registered}", highlight=False, soft_wrap=True)


def _transitions(options: Options) -> tuple[Transitions, Preparation, Transitions, list[Path]]:
    """Return what to train on, how it came about, the evidence to keep, and the folders that all of it comes from."""
    transitions, preparation, source = training_transitions(
        options.robot, options.transitions, options.recording, options.vehicles, options.split
    )
    if options.synthetic is None:
        evidence = held_out(transitions, UNFITTED if preparation.origin == "real" else NONE, MOST_EVIDENCE)
        return transitions, preparation, evidence, [source]
    synthetic = prepared_transitions(options.synthetic, options.robot)
    unseen = set(synthetic[1].learned) <= set(preparation.learned)  # else its generator may have seen any run
    evidence = held_out(transitions, UNFITTED_BY_GENERATOR if unseen else NONE, MOST_EVIDENCE)
    return *mix((transitions, preparation), synthetic, options.real_share), evidence, [source, options.synthetic]


def _train(options: Options, config: ModelConfig, transitions: Transitions, checkpoints: Path) -> Trained:
    seeds = range(options.seed, options.seed + options.seeds)
    epochs = options.recipe.for_model(config, len(transitions.part("train"))).epochs or 0
    with training_bars(f"{options.robot.name} {config.name}", epochs) as report:
        spare = max(len(seeds), FEWEST_SPARE_SEEDS)
        return train(transitions, config, options.recipe, seeds, checkpoints, report, reserve=spare)


def _provenance(trained: Trained, preparation: Preparation) -> Provenance:
    outcomes = []
    for result in trained.results:
        best = result.history[result.best - 1] if result.best else None
        outcomes.append(
            SeedOutcome(
                seed=result.seed,
                best_epoch=result.best,
                position_mm=best.validation_position_mm if best else None,
                orientation_deg=best.validation_orientation_deg if best else None,
                dead=result.dead,
            )
        )
    return Provenance.of(preparation, trained.recipe.model_dump(mode="json"), trained.seed, tuple(outcomes))


def _save(folder: Path, trained: Trained, provenance: Provenance) -> None:
    save_dynamics(folder, trained.dynamics, provenance.model_dump(mode="json"))
    validation = {**provenance.chosen.errors, "seeds": {str(o.seed): o.errors for o in provenance.seeds}}
    parameters = sum(weights.numel() for weights in trained.dynamics.parameters() if weights.requires_grad)
    write_text(
        folder / "metrics.json", json.dumps({"validation": validation, "parameters": parameters}, indent=1) + "\n"
    )
    history = [
        {"seed": result.seed, "epoch": number, **epoch._asdict()}
        for result in trained.results
        for number, epoch in enumerate(result.history, start=1)
    ]
    pd.DataFrame(history).to_csv(folder / "history.csv", index=False, float_format="%.5f")
    history_figure(trained.results).savefig(folder / "history.png")
    shutil.rmtree(folder / CHECKPOINTS, ignore_errors=True)


def _track(tracked: TrackedRun, trained: Trained, provenance: Provenance, seconds: float) -> None:
    tracked.metrics({f"validation_{key}": value for key, value in provenance.chosen.errors.items()})
    tracked.metrics({"training_s": seconds, "dead_seeds": len(trained.dead_seeds)})
    tracked.history((number, epoch._asdict()) for number, epoch in enumerate(trained.best.history, start=1))
    tracked.tag("recording", provenance.recording)
    tracked.tag("recording.digest", provenance.digest)
    tracked.tag("origin", provenance.origin)
    if provenance.generator:
        tracked.tag("generator.digest", provenance.generator.digest)


def _table(name: str, provenance: Provenance) -> Table:
    table = Table("seed", "position mm", "orientation °", "best epoch", "", title=f"{name}: errors on validation runs")
    for outcome in provenance.seeds:
        remark = f"dead: {outcome.dead}" if outcome.dead else "the model" if outcome.seed == provenance.seed else ""
        errors = [f"{error:.2f}" for error in outcome.errors.values()] or ["", ""]
        table.add_row(str(outcome.seed), *errors, str(outcome.best_epoch), remark)
    for column in table.columns[:4]:
        column.justify = "right"
    return table
