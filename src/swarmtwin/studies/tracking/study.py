"""`swarmtwin experiment name=tracking`: how far from the truth the camera's poses are, on rendered pictures."""

import json
from pathlib import Path
from typing import Annotated, Any, Literal

import cv2
import pandas as pd
from pydantic import BeforeValidator, Field
from rich.console import Console
from rich.progress import Progress

from swarmtwin.errors import UserError, near_miss
from swarmtwin.files import new_folder, write_text
from swarmtwin.robot import Robot, Seed, StrictModel
from swarmtwin.studies.tracking.errors import following_ms, measured_errors, summary
from swarmtwin.studies.tracking.methods import TITLES
from swarmtwin.studies.tracking.scenes import Case, Hand
from swarmtwin.studies.tracking.table import tracking_table
from swarmtwin.studies.tracking.tracking_plots import draw_tracking
from swarmtwin.tracking.runs import tracked_run
from swarmtwin.transitions.inputs import as_texts

Count = Annotated[int, Field(ge=1)]


class Options(StrictModel):
    """Options; their defaults stand in conf/experiment/tracking.yaml."""

    name: Literal["tracking"]
    robot: Robot
    vehicles: Annotated[tuple[str, ...], BeforeValidator(as_texts), Field(min_length=1)]
    conditions: dict[str, Case]
    cases: Literal["all"] | Annotated[tuple[str, ...], BeforeValidator(as_texts)]
    pictures: Count
    calibrated_on: Count
    hand: Hand
    seed: Seed
    seeds: Count
    goal_mm: Annotated[float, Field(gt=0)]
    goal_deg: Annotated[float, Field(gt=0)]
    goal_bias_mm: Annotated[float, Field(gt=0)]
    output: Path
    overwrite: bool

    @property
    def chosen(self) -> dict[str, Case]:
        """The cases that are asked for.

        Raises:
            UserError: one of them is nowhere described.
        """
        if self.cases == "all":
            return self.conditions
        if unknown := [name for name in self.cases if name not in self.conditions]:
            raise UserError(f"cases: no such case {unknown[0]!r}: {near_miss(unknown[0], self.conditions)}")
        return {name: self.conditions[name] for name in self.cases}


def run(options: Options) -> dict[str, Any]:
    """Render each case, let all methods look, save and show the table, draw it; return the first case's figures.

    Raises:
        UserError: an unknown case, conditions that make no sense, a robot without a marker, or the output is taken.
    """
    settings, cases = options.model_dump(mode="json"), options.chosen
    cv2.setNumThreads(1)
    with (
        new_folder(options.output, "experiment", settings, options.overwrite) as folder,
        tracked_run("deployment", f"{options.robot.name} tracking", settings, (), options.seed) as tracked,
    ):
        errors = _errors(options, cases, folder)
        errors.to_parquet(folder / "errors.parquet", index=False)
        table = _table(cases, errors)
        table.to_csv(folder / "table.csv", index=False)
        figures = {**_judged(options, table), "following_ms": _following_ms(options, next(iter(cases.values())))}
        write_text(folder / "metrics.json", json.dumps(figures, indent=1) + "\n")
        draw_tracking(folder, folder)
        tracked.metrics({name: float(value) for name, value in figures.items()})
        tracked.folder(folder, "tracking")
    Console().print(tracking_table(options.robot.title, table, figures))
    return {**figures, "output": str(options.output)}


def _errors(options: Options, cases: dict[str, Case], folder: Path) -> pd.DataFrame:
    seeds = range(options.seed, options.seed + options.seeds)
    (folder / "samples").mkdir()
    parts = []
    with Progress(console=Console(stderr=True), transient=True) as bars:
        task = bars.add_task(f"{len(cases)} cases", total=len(cases) * len(seeds))
        for name, case in cases.items():
            for seed in seeds:
                rows, sample = measured_errors(
                    options.robot, options.vehicles, case, seed, options.pictures, options.calibrated_on, options.hand
                )
                parts.append(rows.assign(case=name))
                if seed == options.seed:
                    cv2.imwrite(str(folder / "samples" / f"{name}.png"), sample)
                bars.advance(task)
    return pd.concat(parts, ignore_index=True)


def _table(cases: dict[str, Case], errors: pd.DataFrame) -> pd.DataFrame:
    return pd.DataFrame(
        {"case": name, "case_title": case.title, "method": method, "method_title": title}
        | summary(errors[(errors.case == name) & (errors.method == method)])
        for name, case in cases.items()
        for method, title in TITLES.items()
    )


def _judged(options: Options, table: pd.DataFrame) -> dict[str, float]:
    """Return the figures of the first case, and whether they reach the goals, by how the camera was calibrated."""
    first = table[table.case == table.case.iloc[0]].set_index("method")
    figures: dict[str, float] = {}
    for method in ("tracker", "measured_height", "measured_place", "measured_lens", "perfect"):
        row = first.loc[method]
        figures |= {f"{method}/{name}": float(row[name]) for name in ("p99_mm", "p99_deg", "bias_mm", "found_share")}
        figures[f"{method}/reaches_goal"] = float(
            row.p99_mm <= options.goal_mm and row.p99_deg <= options.goal_deg and row.bias_mm < options.goal_bias_mm
        )
    return figures


def _following_ms(options: Options, case: Case, pictures: int = 30) -> float:
    return following_ms(options.robot, options.vehicles, case, options.seed, pictures)
