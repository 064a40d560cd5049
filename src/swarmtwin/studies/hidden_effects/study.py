"""`swarmtwin experiment name=hidden_effects`: hide effects in stand-ins, and count what the diagnosis makes of them.

Every cause of the catalogue, clear and faint; two and three at once; effects that the catalogue does not know; sessions
with nothing wrong. The diagnosis sees the recordings alone.
"""

import json
import logging
import shutil
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any, Literal

from matplotlib.figure import Figure
from pydantic import BeforeValidator, Field
from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeElapsedColumn, TimeRemainingColumn

from swarmtwin.configuration import config_folder
from swarmtwin.diagnosis.reference import Reference
from swarmtwin.errors import UserError
from swarmtwin.files import CHECKPOINTS, check_output, new_folder, write_text
from swarmtwin.learning.device import one_thread
from swarmtwin.learning.parallel import Report, run_side_by_side
from swarmtwin.learning.progress_bars import quieter
from swarmtwin.robot import Robot, Seed, StrictModel
from swarmtwin.standin.session import require_stand_in
from swarmtwin.studies.hidden_effects.cases import Case, CaseCounts, Plan, draw_cases
from swarmtwin.studies.hidden_effects.detection_plots import (
    clean_figure,
    confusion_figure,
    detection_figure,
    parameters_figure,
)
from swarmtwin.studies.hidden_effects.metrics import CLEAR, Proportion, summarise
from swarmtwin.studies.hidden_effects.results import (
    Result,
    append_result,
    parameters_table,
    read_results,
    results_table,
)
from swarmtwin.studies.hidden_effects.scoring import score_case
from swarmtwin.studies.hidden_effects.sessions import reference_session
from swarmtwin.studies.hidden_effects.tables import study_tables
from swarmtwin.tracking.runs import tracked_run
from swarmtwin.transitions.inputs import as_texts


class ReferenceOptions(StrictModel):
    """How long the recording is that the simulation is learned from."""

    runs: Annotated[int, Field(ge=1)]
    steps: Annotated[int, Field(ge=1)]


class Options(StrictModel):
    """Options; their defaults stand in conf/experiment/hidden_effects.yaml."""

    name: Literal["hidden_effects"]
    robots: Annotated[tuple[str, ...], BeforeValidator(as_texts), Field(min_length=1)]
    cases: Literal["all", "quick"] | Annotated[tuple[str, ...], BeforeValidator(as_texts)]
    count: CaseCounts
    runs: Annotated[int, Field(ge=1)]
    steps: Annotated[int, Field(ge=2)]
    references: Annotated[int, Field(ge=1)]
    reference: ReferenceOptions
    baselines: bool
    processes: Annotated[int, Field(ge=1)] | None
    seed: Seed
    output: Path
    overwrite: bool

    @property
    def plan(self) -> Plan:
        """What all cases are drawn from."""
        return Plan(seed=self.seed, runs=self.runs, steps=self.steps, references=self.references)


@dataclass(frozen=True)
class Batch:
    """Cases that one process compares with the same reference.

    Attributes:
        robot: whose sessions they are.
        options: how long the reference is.
        seed: of the reference.
        cases: to diagnose.
        with_baselines: whether the other methods work on them as well.
    """

    robot: Robot
    options: ReferenceOptions
    seed: int
    cases: tuple[Case, ...]
    with_baselines: bool

    def run(self, report: Report | None) -> None:
        """Learn the reference and score all cases; each result is reported as soon as it is there."""
        with one_thread(), quieter("swarmtwin.transitions", logging.WARNING):
            reference = learned_reference(self.robot, self.options, self.seed)
            for case in self.cases:
                result = score_case(case, self.robot, reference, self.with_baselines)
                if report:
                    report(result)


def learned_reference(robot: Robot, options: ReferenceOptions, seed: int) -> Reference:
    """Learn the simulation of vehicle 1 from a session with nothing wrong."""
    recorded = reference_session(robot, options.runs, options.steps, seed)
    return Reference.learn(recorded.transitions, seed)


def run(options: Options) -> dict[str, Any]:
    """Draw the cases, diagnose each, count, save tables and figures, show the most important ones; return them.

    Raises:
        UserError: a robot without a stand-in, an unknown kind of case, or the output is taken.
    """
    settings = options.model_dump(mode="json")
    check_output(options.output, "experiment", options.overwrite)
    robots = [Robot.load(config_folder() / "robot" / f"{name}.yaml") for name in dict.fromkeys(options.robots)]
    for robot in robots:
        require_stand_in(robot)
    cases = draw_cases(robots, options.plan, options.count, options.cases)
    if not cases:
        raise UserError("no case is left: give more kinds in cases=[...]")
    with (
        new_folder(options.output, "experiment", settings, options.overwrite, resumable=True) as folder,
        tracked_run("diagnosis", "hidden effects", settings, seed=options.seed) as tracked,
    ):
        file = folder / CHECKPOINTS / "results.jsonl"
        results = _results(options, robots, cases, file)
        shutil.copy(file, folder)
        summary = summarise(results)
        _save(folder, results, summary)
        tracked.metrics(_tracked(summary))
        tracked.folder(folder, "hidden_effects")
    console = Console()
    for table in study_tables(summary):
        console.print(table.drawn())
    console.print(f"tables and pictures: {options.output}", highlight=False, soft_wrap=True)
    return {**_tracked(summary), "output": str(options.output)}


def _results(options: Options, robots: list[Robot], cases: list[Case], file: Path) -> list[Result]:
    """Score the cases that a file of results does not know yet, each kept there at once; return all, in order."""
    known = read_results(file, cases)
    columns = (TextColumn("{task.description}"), BarColumn(), MofNCompleteColumn())
    with Progress(*columns, TimeElapsedColumn(), TimeRemainingColumn(), console=Console(stderr=True)) as bar:
        task = bar.add_task("sessions diagnosed", total=len(cases), completed=len(known))

        def keep(result: Result) -> None:
            append_result(file, result)
            known[result.case.key] = result
            bar.advance(task)

        missing = [case for case in cases if case.key not in known]
        run_side_by_side(list(_batches(options, robots, missing)), keep, options.processes)
    return [known[case.key] for case in cases]


def _batches(options: Options, robots: list[Robot], cases: list[Case], largest: int = 16) -> Iterator[Batch]:
    """Put cases of one robot and reference together, `largest` at most: more would leave processes idle in the end."""
    for robot in robots:
        for number in range(options.references):
            own = [case for case in cases if case.robot == robot.name and case.reference == number]
            seed = int(options.plan.rng("reference", robot.name, number).integers(2**31))
            for first in range(0, len(own), largest):
                yield Batch(robot, options.reference, seed, tuple(own[first : first + largest]), options.baselines)


def _save(folder: Path, results: list[Result], summary: dict[str, Any]) -> None:
    table, parameters = results_table(results), parameters_table(results)
    rounded = table.infer_objects().round({"rise_percent": 2, "seconds": 2}).round(4)
    rounded.to_csv(folder / "results.csv", index=False)
    parameters.to_csv(folder / "parameters.csv", index=False)
    write_text(folder / "metrics.json", json.dumps(summary, indent=1, default=Proportion.model_dump) + "\n")
    figures: dict[str, Figure] = {
        "confusion": confusion_figure(table),
        "detection": detection_figure(table),
        "parameters": parameters_figure(parameters),
        "clean": clean_figure(table),
    }
    for name, figure in figures.items():
        figure.savefig(folder / f"{name}.png")
    pictures = "\n\n".join(f"![{name}]({name}.png)" for name in figures)
    tables = "\n".join(table.markdown() for table in study_tables(summary))
    write_text(folder / "report.md", f"# Hidden effects\n\n{tables}\n{pictures}\n")


def _tracked(summary: dict[str, Any]) -> dict[str, float]:
    proportions = {
        "single_found": summary["single"][CLEAR]["found"],
        "single_named_first": summary["single"][CLEAR]["named_first"],
        "pair_exact": summary["pair"]["exact"],
        "triple_exact": summary["triple"]["exact"],
        "outside_not_named": summary["outside"]["not_named"],
        "clean_accused": summary["clean"]["accused"],
        "intervals_covered": summary["covered"],
    }
    return {name: one.share for name, one in proportions.items() if one.share is not None}
