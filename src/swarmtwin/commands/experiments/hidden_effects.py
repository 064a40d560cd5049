"""`swarmtwin experiment name=hidden_effects`: hide effects in stand-ins, and count what the diagnosis makes of them.

Every cause of the catalogue, clear and faint; two and three at once; effects that the catalogue does not know; sessions
with nothing wrong. The diagnosis sees the recordings alone.
"""

from pathlib import Path
from typing import Annotated, Any, Literal

import pandas as pd
from matplotlib.figure import Figure
from pydantic import BeforeValidator, Field
from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeElapsedColumn, TimeRemainingColumn

from swarmtwin.commands.experiments.hidden_effects_cases import Counts, Plan, draw_cases
from swarmtwin.commands.experiments.hidden_effects_counts import CLEAR
from swarmtwin.commands.experiments.hidden_effects_figures import (
    clean_figure,
    confusion_figure,
    detection_figure,
    parameters_figure,
)
from swarmtwin.commands.experiments.hidden_effects_results import Parameter, Result
from swarmtwin.commands.experiments.hidden_effects_study import ReferenceOptions, run_cases
from swarmtwin.commands.experiments.hidden_effects_summary import Summary, summarise
from swarmtwin.commands.experiments.hidden_effects_tables import sheets
from swarmtwin.commands.sources import as_texts
from swarmtwin.configuration import config_folder
from swarmtwin.errors import UserError
from swarmtwin.files import check_output, new_folder, write_text
from swarmtwin.robot import Robot, Seed, StrictModel
from swarmtwin.standin.session import require_stand_in
from swarmtwin.tracking import tracked_run

LINES = "results.jsonl"


class Options(StrictModel):
    """Options; their defaults stand in conf/experiment/hidden_effects.yaml."""

    name: Literal["hidden_effects"]
    robots: Annotated[tuple[str, ...], BeforeValidator(as_texts), Field(min_length=1)]
    cases: Literal["all", "quick"] | Annotated[tuple[str, ...], BeforeValidator(as_texts)]
    count: Counts
    runs: Annotated[int, Field(ge=1)]
    steps: Annotated[int, Field(ge=2)]
    references: Annotated[int, Field(ge=1)]
    reference: ReferenceOptions
    baselines: bool
    processes: Annotated[int, Field(ge=1)] | None
    seed: Seed
    output: Path
    overwrite: bool


def run(options: Options) -> None:
    """Draw the cases, diagnose each, count, save tables and figures, and show the most important ones.

    Raises:
        UserError: a robot without a stand-in, an unknown kind of case, or the output is taken.
    """
    settings = options.model_dump(mode="json")
    check_output(options.output, "experiment", options.overwrite)
    robots = [Robot.load(config_folder() / "robot" / f"{name}.yaml") for name in dict.fromkeys(options.robots)]
    for robot in robots:
        require_stand_in(robot)
    plan = Plan(seed=options.seed, runs=options.runs, steps=options.steps, references=options.references)
    cases = draw_cases(robots, plan, options.count, options.cases)
    if not cases:
        raise UserError("no case is left: give more kinds in cases=[...]")
    with tracked_run("diagnosis", "hidden effects", settings, seed=options.seed) as tracked:
        with new_folder(options.output, "experiment", settings, options.overwrite, keep_partial=True) as folder:
            with _bar() as bar:
                task = bar.add_task("sessions diagnosed", total=len(cases))
                results = run_cases(
                    cases,
                    robots,
                    plan,
                    options.reference,
                    options.baselines,
                    folder / LINES,
                    lambda done: bar.advance(task, done),
                    options.processes,
                )
            summary = summarise(results)
            _save(folder, results, summary)
        tracked.metrics(_tracked(summary))
        tracked.folder(options.output, "hidden_effects")
    console = Console()
    for sheet in sheets(summary):
        console.print(sheet.drawn())
    console.print(f"tables and pictures: {options.output}", highlight=False, soft_wrap=True)


def _bar() -> Progress:
    columns = (
        TextColumn("{task.description}"),
        BarColumn(),
        MofNCompleteColumn(),
        TimeElapsedColumn(),
        TimeRemainingColumn(),
    )
    return Progress(*columns, console=Console(stderr=True))


def _save(folder: Path, results: list[Result], summary: Summary) -> None:
    pd.DataFrame([result.row() for result in results]).to_csv(folder / "results.csv", index=False)
    parameters = [
        {"robot": result.case.robot, "kind": result.case.kind, "seed": result.case.seed, **parameter.model_dump()}
        for result in results
        for parameter in result.parameters
    ]
    columns = ["robot", "kind", "seed", *Parameter.model_fields]
    pd.DataFrame(parameters, columns=columns).to_csv(folder / "parameters.csv", index=False)
    write_text(folder / "metrics.json", summary.model_dump_json(indent=1) + "\n")
    figures: dict[str, Figure] = {
        "confusion": confusion_figure(results),
        "detection": detection_figure(results),
        "parameters": parameters_figure(results),
        "clean": clean_figure(results),
    }
    for name, figure in figures.items():
        figure.savefig(folder / f"{name}.png")
    pictures = "\n\n".join(f"![{name}]({name}.png)" for name in figures)
    tables = "\n".join(sheet.markdown() for sheet in sheets(summary))
    write_text(folder / "report.md", f"# Hidden effects\n\n{tables}\n{pictures}\n")


def _tracked(summary: Summary) -> dict[str, Any]:
    shares = {
        "single_found": summary.single[CLEAR].found,
        "single_named_first": summary.single[CLEAR].named_first,
        "pair_exact": summary.pair.exact,
        "triple_exact": summary.triple.exact,
        "outside_not_named": summary.outside.not_named,
        "clean_accused": summary.clean.accused,
        "intervals_covered": summary.covered,
    }
    return {name: share.share for name, share in shares.items() if share.share is not None}
