"""`swarmtwin experiment name=synthetic`: what models learn from synthetic transitions instead of real ones.

The half of tables 1 and 2 of the paper that is trained on synthetic data, its figures 8 and 10 in small, and the
controls that it lacks: equal numbers of optimiser steps; the ensemble that our generator predicts the mean with, used
directly; and CR-Net given the walls that this ensemble is given.
"""

import json
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any, Literal

import numpy as np
import pandas as pd
from pydantic import BeforeValidator, Field
from rich.console import Console
from rich.progress import Progress

from swarmtwin.dynamics.model_config import model_config
from swarmtwin.dynamics.training import TrainingJob, train_seeds
from swarmtwin.files import new_folder, write_text
from swarmtwin.generators.generator import generator_config
from swarmtwin.learning.recipe import Recipe
from swarmtwin.recordings.reading import read_recording
from swarmtwin.recordings.recording import Recording
from swarmtwin.robot import Robot, Seed, StrictModel
from swarmtwin.simulation.evaluation import Measured, Measurement, measure
from swarmtwin.simulation.simulation import Simulation
from swarmtwin.studies.synthetic.error_plots import draw_cases
from swarmtwin.studies.synthetic.table import ERRORS, case_table
from swarmtwin.studies.synthetic.trainings import (
    Amount,
    Case,
    Training,
    TrainingSets,
    chosen_cases,
    trained_before,
)
from swarmtwin.studies.tracked_inputs import recording_input, split_inputs
from swarmtwin.studies.training_sets import TrainedModel, trained_model
from swarmtwin.tracking.runs import tracked_run
from swarmtwin.transitions.inputs import as_texts, prepared_transitions
from swarmtwin.transitions.mixing import Prepared

Count = Annotated[int, Field(ge=1)]


class Options(StrictModel):
    """Options; their defaults stand in conf/experiment/synthetic.yaml."""

    name: Literal["synthetic"]
    robot: Robot
    crnet: dict[str, Any]
    mlp: dict[str, Any]
    ensemble: dict[str, Any]
    recipe: Recipe
    generator: dict[str, Any]
    published: dict[str, Any]
    transitions: Path
    generators: Path
    models: Annotated[tuple[Path, ...], BeforeValidator(as_texts)]
    train_vehicle: Path
    other_vehicle: Path
    part: Annotated[float, Field(gt=0, lt=1)]
    few: Count
    synthetic: Count
    cases: Literal["all"] | Annotated[tuple[str, ...], BeforeValidator(as_texts)]
    seed: Seed
    seeds: Count
    pictures: bool
    output: Path
    overwrite: bool

    @property
    def recordings(self) -> dict[str, Path]:
        """The recordings to measure on, by what they are for."""
        return {"train_vehicle": self.train_vehicle, "other_vehicle": self.other_vehicle}


@dataclass(frozen=True)
class Outcome:
    """What came of a training.

    Attributes:
        training: of which case.
        models: one a seed.
        measurements: by recording, one a live seed.
    """

    training: Training
    models: tuple[TrainedModel, ...]
    measurements: dict[str, tuple[Measurement, ...]]


def run(options: Options) -> dict[str, Any]:
    """Train every case, measure it, save table and picture, and show the table; return the best case.

    Raises:
        UserError: no transitions or recording, an unknown case, or the output is taken.
    """
    settings = options.model_dump(mode="json")
    cases = chosen_cases(options.cases, options.robot)
    inputs = [options.transitions, *options.recordings.values(), *options.models]
    real = prepared_transitions(options.transitions, options.robot)
    recordings = {name: read_recording(folder, options.robot) for name, folder in options.recordings.items()}
    given = [
        *split_inputs(options.transitions, real[0]),
        *(recording_input(options.recordings[name], "test", recording) for name, recording in recordings.items()),
    ]
    with (
        new_folder(options.output, "experiment", settings, options.overwrite, inputs=inputs) as folder,
        tracked_run("generator", f"{options.robot.name} real and synthetic", settings, given, options.seed) as tracked,
    ):
        outcomes = _outcomes(options, cases, real, recordings)
        table = pd.DataFrame([row for outcome in outcomes for row in _rows(outcome)])
        table.to_csv(folder / "table.csv", index=False)
        write_text(folder / "metrics.json", json.dumps(_metrics(outcomes), indent=1) + "\n")
        if options.pictures:
            draw_cases(folder, folder)
        for row in table.to_dict("records"):
            figures = {name: row[name] for name in ERRORS if row[name] is not None}
            tracked.metrics({f"{row['case']}/{row['recording']}/{name}": value for name, value in figures.items()})
        tracked.folder(folder, "comparison")
    Console().print(case_table(options.robot.title, table).drawn())
    measured = table[table.recording == "train_vehicle"].dropna(subset="position_mm").sort_values("position_mm")
    figures = {f"best_{name}": row[name] for row in measured.head(1).to_dict("records") for name in ("case", *ERRORS)}
    return {**figures, "output": str(options.output)}


def _trainings(options: Options, cases: dict[str, Case], real: Prepared) -> Iterator[Training]:
    configs = {name: model_config(getattr(options, name), name) for name in ("crnet", "mlp", "ensemble")}
    generators = {name: generator_config(getattr(options, name), name) for name in ("generator", "published")}
    less: dict[Amount, int] = {"part": round(options.part * len(real[0])), "few": options.few}
    sets = TrainingSets(real, less, options.synthetic, generators, options.generators, options.seed)
    for name, case in cases.items():
        transitions, preparation = sets.of(case)
        config = configs[case.model]
        if case.walls:
            config = config.model_copy(update={"wall_reaches": configs["ensemble"].wall_reaches})
        learned = len((real[0] if case.at_epochs else transitions).part("train"))
        recipe = options.recipe.completed(config.learning_rate, config.steps, learned)
        seeds = range(options.seed, options.seed + options.seeds)
        jobs = tuple(TrainingJob(transitions, config, recipe, seed) for seed in seeds)
        yield Training(name, case, preparation, jobs)


def _outcomes(
    options: Options, cases: dict[str, Case], real: Prepared, recordings: Mapping[str, Recording]
) -> list[Outcome]:
    trainings = list(_trainings(options, cases, real))
    measured = {name: Measured.of(recording, options.recordings[name]) for name, recording in recordings.items()}
    models = _models(trainings, options.models)
    outcomes = []
    for training in trainings:
        own = tuple(next(models) for _ in training.jobs)
        measurements = {
            place: tuple(measure(Simulation(one.dynamics), one.provenance, each) for one in own if one.dynamics)
            for place, each in measured.items()
        }
        outcomes.append(Outcome(training, own, measurements))
    return outcomes


def _models(trainings: Sequence[Training], folders: Sequence[Path]) -> Iterator[TrainedModel]:
    """Return the models of all trainings in their order: those that lie in folders, and the others, trained here."""
    wanted = [(job, training.preparation) for training in trainings for job in training.jobs]
    found = [trained_before(folders, *each) for each in wanted]
    jobs = [job for (job, _), model in zip(wanted, found, strict=True) if model is None]
    with Progress(console=Console(stderr=True)) as bars:
        task = bars.add_task(f"{len(jobs)} trainings", total=sum(job.recipe.epochs or 0 for job in jobs))
        results = iter(train_seeds(jobs, lambda *_: bars.advance(task), None))
    for each, model in zip(wanted, found, strict=True):
        yield model or trained_model(*each, next(results))


def _rows(outcome: Outcome) -> list[dict[str, Any]]:
    """Return a case's rows of table.csv: one a recording, mean and spread over its live seeds."""
    training = outcome.training
    about = {
        "case": training.name,
        "title": training.case.title,
        "inputs": training.inputs,
        "real": training.real_rows,
        "learned_from": training.preparation.transitions["train"],
        "steps": training.steps,
        "seeds": len(outcome.models),
        "dead_seeds": sum(model.dead is not None for model in outcome.models),
    }
    return [{**about, "recording": place, **_errors(own)} for place, own in outcome.measurements.items()]


def _errors(measurements: Sequence[Measurement]) -> dict[str, float | None]:
    row: dict[str, float | None] = {}
    for name in ERRORS:
        values = [getattr(each.overall.one_step, name) for each in measurements]
        row[name] = float(np.mean(values)) if values else None
        row[f"{name}_over_seeds"] = float(np.std(values, ddof=1)) if len(values) > 1 else None
        row[f"floor_{name}"] = getattr(measurements[0].overall.floor, name) if values else None
        exact = [getattr(each.overall.model_error, name) for each in measurements if each.overall.model_error]
        row[f"model_error_{name}"] = float(np.mean(exact)) if exact else None
    return row


def _metrics(outcomes: Sequence[Outcome]) -> dict[str, Any]:
    return {
        outcome.training.name: {
            "steps": outcome.training.steps,
            "dead": {str(model.seed): model.dead for model in outcome.models if model.dead},
            **{place: [each.overall.plain() for each in own] for place, own in outcome.measurements.items()},
        }
        for outcome in outcomes
    }
