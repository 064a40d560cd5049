"""`swarmtwin experiment name=generators`: generators side by side, to choose and to tune them by.

CR-Net as the student of each, judged on validation runs, and beside its errors what the paper leaves out: whether the
noise is as wide as the real one's, whether generated transitions cover the real ones, and whether they are copies.
Students take equal numbers of optimiser steps. The same generator may stand there several times, with other epochs.
"""

import json
import time
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any, Literal

import numpy as np
import pandas as pd
import torch
from pydantic import Field
from rich.console import Console
from rich.progress import Progress

from swarmtwin.dynamics.evaluation import ErrorFigure, one_step
from swarmtwin.dynamics.model_config import ModelConfig, model_config
from swarmtwin.dynamics.predictor import NetworkDynamics
from swarmtwin.dynamics.training import SeedResult, TrainingJob, train_seeds
from swarmtwin.files import new_folder, write_text
from swarmtwin.generators.generator import GeneratorConfig, generator_config
from swarmtwin.generators.quality import Comparison, Quality
from swarmtwin.generators.synthesis import Synthesis, save_synthesis, synthesise
from swarmtwin.learning.recipe import Recipe
from swarmtwin.robot import Robot, Seed, StrictModel
from swarmtwin.studies.generators.table import generator_table
from swarmtwin.studies.tracked_inputs import split_inputs
from swarmtwin.tracking.runs import tracked_run
from swarmtwin.transitions import Transitions
from swarmtwin.transitions.inputs import prepared_transitions
from swarmtwin.transitions.mixing import Prepared

Count = Annotated[int, Field(ge=2)]


class Options(StrictModel):
    """Options; their defaults stand in conf/experiment/generators.yaml."""

    name: Literal["generators"]
    robot: Robot
    student: dict[str, Any]
    recipe: Recipe
    generators: Annotated[dict[str, dict[str, Any]], Field(min_length=1)]
    transitions: Path
    synthetic: Count
    judged_on: Literal["validation", "test"]
    seed: Seed
    output: Path
    overwrite: bool


@dataclass(frozen=True)
class Candidate:
    """A generator that was trained and drawn from.

    Attributes:
        made: what came of it.
        cpu_s: how long its training, drawing and assessment computed.
        prepared: what a student learns from.
    """

    made: Synthesis
    cpu_s: float
    prepared: Prepared


def run(options: Options) -> dict[str, Any]:
    """Train every generator and its student, save and show the table; return the best student's generator.

    Raises:
        UserError: no transitions, an unknown generator, one that has learned nothing, or the output is taken.
    """
    settings = options.model_dump(mode="json")
    configs = {label: generator_config(content, f"generators.{label}") for label, content in options.generators.items()}
    student = model_config(options.student, "student")
    real = prepared_transitions(options.transitions, options.robot)
    given = split_inputs(options.transitions, real[0])
    with (
        new_folder(options.output, "experiment", settings, options.overwrite, inputs=[options.transitions]) as folder,
        tracked_run("generator", f"{options.robot.name} generators", settings, given, options.seed) as tracked,
    ):
        candidates = {}
        for label, candidate in _candidates(options, configs, real):
            candidates[label] = candidate
            (folder / label).mkdir()
            save_synthesis(folder / label, candidate.made, options.seed)
        students = _students(options, student, {"real": real[0]} | {k: c.prepared[0] for k, c in candidates.items()})
        rows = list(_rows(options, student, real[0], candidates, students))
        table = pd.DataFrame(rows)
        table.to_csv(folder / "table.csv", index=False, float_format="%.6g")
        write_text(folder / "metrics.json", json.dumps({row["generator"]: row for row in rows}, indent=1) + "\n")
        for row in rows:
            figures = {key: value for key, value in row.items() if isinstance(value, int | float)}
            tracked.metrics(
                {f"{row['generator']}/{key}": value for key, value in figures.items() if np.isfinite(value)}
            )
        tracked.folder(folder, "comparison")
    Console().print(generator_table(options.robot.title, table, student.name, options.judged_on))
    best = table[table.generator != "real"].dropna(subset="position_mm").sort_values("position_mm").head(1)
    figures = {name: row[name] for row in best.to_dict("records") for name in ("generator", "position_mm")}
    return {**figures, "output": str(options.output)}


def _candidates(
    options: Options, configs: Mapping[str, GeneratorConfig], real: Prepared
) -> Iterator[tuple[str, Candidate]]:
    with Progress(console=Console(stderr=True)) as bars:
        for label, config in configs.items():
            task = bars.add_task(label, total=None)
            started = time.process_time()
            made = synthesise(
                *real,
                config,
                options.seed,
                real=None,
                count=options.synthetic,
                report=lambda record, steps, task=task: bars.update(task, total=steps, completed=record["step"]),  # type: ignore[misc]
            )
            cpu_s = time.process_time() - started
            columns, name = made.generator.columns, config.name
            prepared = made.lineage.synthetic(columns, made.drawn, name, "kept beside the table", options.seed)
            yield label, Candidate(made, cpu_s, prepared)


def _students(options: Options, config: ModelConfig, given: Mapping[str, Transitions]) -> dict[str, SeedResult]:
    """Train one student on each set of transitions, all for as many steps as the model's own."""
    jobs = []
    for transitions in given.values():
        recipe = options.recipe.completed(config.learning_rate, config.steps, len(transitions.part("train")))
        jobs.append(TrainingJob(transitions, config, recipe, options.seed))
    with Progress(console=Console(stderr=True)) as bars:
        task = bars.add_task(f"{len(jobs)} students", total=sum(job.epochs for job in jobs))
        results = train_seeds(jobs, lambda *_: bars.advance(task), None)
    return dict(zip(given, results, strict=True))


def _rows(
    options: Options,
    config: ModelConfig,
    real: Transitions,
    candidates: Mapping[str, Candidate],
    students: Mapping[str, SeedResult],
) -> Iterator[dict[str, Any]]:
    """Return the rows of table.csv, real transitions first: all have the same columns."""
    judged_on = real.part(options.judged_on)
    first = next(iter(candidates.values())).made.quality
    for label, student in students.items():
        candidate = candidates.get(label)
        error: dict[str, Any] = {}
        if student.dead is None:
            weights = {name: torch.from_numpy(values) for name, values in student.weights.items()}
            dynamics = NetworkDynamics.with_weights(real.robot, config, weights)
            error = one_step(dynamics, judged_on)._asdict()
            del error["transitions"]
        quality = candidate.made.quality if candidate else first
        yield {
            "generator": label,
            "kind": candidate.made.generator.config.name if candidate else "",
            **{name: error.get(name) for name in ErrorFigure._fields if name != "transitions"},
            "dead": student.dead,
            **_quality_columns(quality, quality.synthetic if candidate else quality.real),
            "nearer_to_learned": quality.nearer_to_learned if candidate else None,
            "exact_copies": quality.exact_copies if candidate else None,
            "redrawn_share": quality.redrawn_share if candidate else None,
            "generator_cpu_s": round(candidate.cpu_s, 1) if candidate else None,
        }


def _quality_columns(quality: Quality, rows: Comparison) -> dict[str, float]:
    """Return the figures that real rows have as well, spreads as multiples of held-out ones."""
    spread = {f"spread_{name}_ratio": rows.spread[name] / known for name, known in quality.held_out_spread.items()}
    return {
        **{name.replace("_mm", "").replace("_rad", ""): ratio for name, ratio in spread.items()},
        "precision": rows.precision,
        "recall": rows.recall,
        "neighbour_distance": rows.neighbour_distance,
        "told_apart": rows.told_apart.value,
    }
