"""`swarmtwin experiment name=hidden_effects`: hide effects in stand-ins, and count what the diagnosis makes of them.

Every cause of the catalogue, clear and faint; two and three at once; causes by another law than their mechanisms';
what no catalogue knows; sessions with nothing wrong: on several families of stand-ins, each session with a reference of
its own. The diagnosis sees two recordings.
"""

import json
import logging
import math
import shutil
from dataclasses import dataclass, replace
from itertools import groupby
from pathlib import Path
from typing import Annotated, Any, Literal

from matplotlib.figure import Figure
from pydantic import BeforeValidator, Field
from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeElapsedColumn, TimeRemainingColumn

from swarmtwin.configuration import config_folder
from swarmtwin.errors import UserError, near_miss
from swarmtwin.files import CHECKPOINTS, check_output, new_folder, write_text
from swarmtwin.learning.device import one_thread
from swarmtwin.learning.parallel import Report, run_side_by_side
from swarmtwin.learning.progress_bars import quieter
from swarmtwin.learning.ray_cluster import run_on_cluster
from swarmtwin.robot import Robot, Seed, StrictModel
from swarmtwin.standin.session import require_stand_in
from swarmtwin.studies.hidden_effects.baselines.engine_identification import load_identification
from swarmtwin.studies.hidden_effects.cases import KINDS, Case, Kind, cases
from swarmtwin.studies.hidden_effects.detection_plots import (
    calibration_figure,
    clean_figure,
    confusion_figure,
    detection_figure,
    parameters_figure,
)
from swarmtwin.studies.hidden_effects.metrics import summarise
from swarmtwin.studies.hidden_effects.proportions import CLEAR, Proportion
from swarmtwin.studies.hidden_effects.results import (
    Result,
    append_result,
    confidences_table,
    filled,
    parameters_table,
    read_results,
    results_table,
)
from swarmtwin.studies.hidden_effects.scoring import score_case
from swarmtwin.studies.hidden_effects.sessions import is_of_known_vehicle
from swarmtwin.studies.hidden_effects.tables import study_tables
from swarmtwin.studies.stand_in_families import chosen_families
from swarmtwin.tracking.runs import tracked_run
from swarmtwin.transitions.inputs import as_texts

Words = Annotated[tuple[str, ...], BeforeValidator(as_texts), Field(min_length=1)]
Count = Annotated[int, Field(ge=0)]


class SessionCounts(StrictModel):
    """How many sessions of each kind there are in each family."""

    one: Count
    two: Count
    three: Count
    misspecified: Count
    outside: Count
    clean: Count


class Scales(StrictModel):
    """How large the study is."""

    quick: SessionCounts
    full: SessionCounts


class Shares(StrictModel):
    """On which share of the sessions of each kind in each family, the first ones, other methods work as well."""

    quick: Annotated[float, Field(ge=0, le=1)]
    full: Annotated[float, Field(ge=0, le=1)]


class Lengths(StrictModel):
    """How long recordings are: runs of a usual session, transitions in its runs, and runs of its reference."""

    runs: Annotated[int, Field(ge=8)]
    steps: Annotated[int, Field(ge=2)]
    reference_runs: Annotated[int, Field(ge=8)]


class Options(StrictModel):
    """Options; their defaults stand in conf/experiment/hidden_effects.yaml."""

    name: Literal["hidden_effects"]
    scale: Literal["quick", "full"]
    count: Scales
    families: Words | None
    kinds: Words
    robots: Words
    lengths: Lengths
    reference_vehicles: Annotated[int, Field(ge=1, le=7)]
    vehicle: Literal["any", "known", "another"]
    baselines: Shares
    true_model: Shares
    processes: Annotated[int, Field(ge=1)] | None
    cluster: str | None
    judged: tuple[Path, ...]
    seed: Seed
    output: Path
    overwrite: bool

    def drawn_cases(self) -> list[Case]:
        """Return the cases, family by family and kind by kind.

        Raises:
            UserError: a family or kind that there is not, or a family whose engine is missing.
        """
        counts = getattr(self.count, self.scale).model_dump()
        lengths = self.lengths.model_dump() | {"reference_vehicles": self.reference_vehicles}
        return [
            case
            for family in chosen_families(self.families)
            for kind in self._chosen_kinds()
            for case in cases(family, kind, counts[kind], self.seed, self.robots, **lengths)
            if self.vehicle == "any" or is_of_known_vehicle(case) == (self.vehicle == "known")
        ]

    def jobs(self) -> list["ScoringJob"]:
        """Return the cases with what is to be done with each.

        Raises:
            UserError: as of `drawn_cases`, or the toolbox that the rigid body is compared with is missing.
        """
        shares = [getattr(shares, self.scale) for shares in (self.baselines, self.true_model)]
        jobs = []
        for _, own in groupby(self.drawn_cases(), key=lambda case: (case.family, case.kind)):
            drawn = list(own)
            first = [math.ceil(share * len(drawn)) for share in shares]
            jobs += [ScoringJob(case, *(number < count for count in first)) for number, case in enumerate(drawn)]
        if any(job.with_true_model and job.case.family == "rigid_body" for job in jobs):
            load_identification()
        return jobs

    def _chosen_kinds(self) -> tuple[Kind, ...]:
        for kind in self.kinds:
            if kind not in KINDS:
                raise UserError(f"kinds: no such kind: {kind!r}: {near_miss(kind, KINDS)}")
        return tuple(kind for kind in KINDS if kind in self.kinds)


@dataclass(frozen=True)
class ScoringJob:
    """A case that one process records, diagnoses and judges.

    Attributes:
        case: the session.
        with_baselines: whether the other methods work on it as well.
        with_true_model: whether the method that has the true model does.
        judged: what has been made of it before, where that lacks something; null where nothing was.
    """

    case: Case
    with_baselines: bool
    with_true_model: bool
    judged: Result | None = None

    def is_answered_by(self, result: Result) -> bool:
        """Return whether a result of the case holds all that is asked for."""
        lacks_baselines = self.with_baselines and result.baselines is None and result.failure is None
        return not lacks_baselines and not (self.with_true_model and result.true_model is None)

    def run(self, report: Report | None) -> None:
        """Score the case; its result is reported as soon as it is there."""
        with one_thread(), quieter("swarmtwin.transitions", logging.WARNING):
            result = score_case(self.case, self.with_baselines, self.with_true_model, self.judged)
        if report:
            report(result)


def run(options: Options) -> dict[str, Any]:
    """Draw the cases, diagnose each, count, save tables and figures, show the most important ones; return them.

    Raises:
        UserError: a robot without a stand-in, an unknown kind or family of sessions, something that is not installed,
            or the output is taken.
    """
    settings = options.model_dump(mode="json")
    check_output(options.output, "experiment", options.overwrite)
    for name in dict.fromkeys(options.robots):
        require_stand_in(Robot.load(config_folder() / "robot" / f"{name}.yaml"))
    jobs = options.jobs()
    if not jobs:
        raise UserError(f"no session is left: give more in count.{options.scale}, kinds=[...] or families=[...]")
    for path in options.judged:
        if not path.is_file():
            raise UserError(f"judged={path}: no such file: name the results.jsonl that another call has left")
    with (
        new_folder(options.output, "experiment", settings, options.overwrite, resumable=True) as folder,
        tracked_run("diagnosis", "hidden effects", settings, seed=options.seed) as tracked,
    ):
        file = folder / CHECKPOINTS / "results.jsonl"
        results = _results(jobs, file, options)
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


def _results(jobs: list[ScoringJob], file: Path, options: Options) -> list[Result]:
    """Score the cases that a file of results does not know yet, each kept there at once; return all, in order.

    What other files know of them is taken over; what these lack is added.
    """
    cases = [job.case for job in jobs]
    known = kept = read_results(file, cases)
    for path in options.judged:
        others = read_results(path, cases)
        known = known | {key: filled(known.get(key), result) for key, result in others.items()}
    for key, result in known.items():
        if result != kept.get(key):
            append_result(file, result)
    columns = (TextColumn("{task.description}"), BarColumn(), MofNCompleteColumn())
    with Progress(*columns, TimeElapsedColumn(), TimeRemainingColumn(), console=Console(stderr=True)) as bar:
        missing = [
            replace(job, judged=known.get(job.case.key))
            for job in jobs
            if job.case.key not in known or not job.is_answered_by(known[job.case.key])
        ]
        task = bar.add_task("sessions diagnosed", total=len(jobs), completed=len(jobs) - len(missing))

        def keep(result: Result) -> None:
            append_result(file, result)
            known[result.case.key] = result
            bar.advance(task)

        if options.cluster is None:
            run_side_by_side(missing, keep, options.processes)
        elif missing:
            address = None if options.cluster == "local" else options.cluster
            run_on_cluster(missing, keep, address, f"cluster={options.cluster}")
    return [known[job.case.key] for job in jobs]


def _save(folder: Path, results: list[Result], summary: dict[str, Any]) -> None:
    table, parameters = results_table(results), parameters_table(results)
    rounded = table.infer_objects().round({"rise_percent": 2, "seconds": 2, "learning_seconds": 2, "memory_mb": 0})
    rounded.round(4).to_csv(folder / "results.csv", index=False)
    parameters.to_csv(folder / "parameters.csv", index=False)
    write_text(folder / "metrics.json", json.dumps(summary, indent=1, default=Proportion.model_dump) + "\n")
    figures: dict[str, Figure] = {}
    if (table.kind != "clean").any():
        figures["confusion"] = confusion_figure(table)
    if (table.kind == "one").any():
        figures["detection"] = detection_figure(table)
    if len(parameters):
        figures["parameters"] = parameters_figure(parameters)
    if (table.kind != "clean").any():
        figures["calibration"] = calibration_figure(confidences_table(results))
    if (table.kind == "clean").any():
        figures["clean"] = clean_figure(table)
    for name, figure in figures.items():
        figure.savefig(folder / f"{name}.png")
    pictures = "\n\n".join(f"![{name}]({name}.png)" for name in figures)
    tables = "\n".join(table.markdown() for table in study_tables(summary))
    write_text(folder / "report.md", f"# Hidden effects\n\n{tables}\n{pictures}\n")


def _tracked(summary: dict[str, Any]) -> dict[str, float]:
    """Return the headline figures of each family, as MLflow keeps them."""
    figures: dict[str, float] = {}
    for family, own in summary["families"].items():
        proportions = {
            "one_exact": own["one"][CLEAR]["exact"],
            "two_exact": own["two"]["exact"],
            "three_exact": own["three"]["exact"],
            "outside_not_named": own["outside"]["not_named"],
            "clean_accused": own["clean"]["accused"],
            "clean_alarmed": own["clean"]["alarmed"],
            "intervals_covered": own["covered"],
        }
        figures |= {f"{family}_{name}": one.share for name, one in proportions.items() if one.share is not None}
    return figures
