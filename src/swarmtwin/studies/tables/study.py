"""`swarmtwin experiment name=tables`: what the pipeline made for a robot, as tables in a text file."""

import json
from collections.abc import Iterator
from pathlib import Path
from typing import Any, Literal

import pandas as pd
from rich.console import Console

from swarmtwin.errors import UserError
from swarmtwin.files import new_folder, write_text
from swarmtwin.robot import Robot, StrictModel
from swarmtwin.studies.dynamics.table import model_table
from swarmtwin.studies.study_table import StudyTable
from swarmtwin.studies.synthetic.table import case_table
from swarmtwin.studies.transfer.table import policy_table

FILE = "tables.md"


class Options(StrictModel):
    """Options; their defaults stand in conf/experiment/tables.yaml."""

    name: Literal["tables"]
    robot: Robot
    artifacts: Path
    output: Path
    overwrite: bool


def run(options: Options) -> dict[str, Any]:
    """Write tables.md; return where it is.

    Raises:
        UserError: the pipeline has not run, what it left is damaged, or the output is taken.
    """
    try:
        tables = list(_tables(options.artifacts, options.robot))
    except (ValueError, KeyError) as error:
        left = f"{options.artifacts}: what the pipeline left of robot {options.robot.name!r}"
        raise UserError(f"{left} is damaged ({error}): run `dvc repro`") from None
    with new_folder(options.output, "experiment", options.model_dump(mode="json"), options.overwrite) as folder:
        write_text(folder / FILE, "\n".join(table.markdown() for table in tables))
    Console().print(f"tables: {options.output / FILE}", highlight=False, soft_wrap=True)
    return {"output": str(options.output)}


def _tables(artifacts: Path, robot: Robot) -> Iterator[StudyTable]:
    yield model_table(robot.title, _table(artifacts / "comparison" / robot.name))
    yield case_table(robot.title, _table(artifacts / "real_and_synthetic" / robot.name))
    yield _new_scenarios(robot, artifacts / "policies" / robot.name)
    yield policy_table(robot.title, _table(artifacts / "transfer" / robot.name))


def _table(folder: Path) -> pd.DataFrame:
    file = folder / "table.csv"
    if not file.is_file():
        raise UserError(f"{file} is missing: run `dvc repro` first")
    return pd.read_csv(file)


def _new_scenarios(robot: Robot, policies: Path) -> StudyTable:
    """Return how each policy did in the simulation that it was learned in, in scenarios by which nothing was chosen."""
    rows = []
    for file in sorted(policies.glob("*/metrics.json")):
        test = json.loads(file.read_text())["test"]
        rates = ([100 * test[name][end] for end in ("value", "low", "high")] for name in ("success", "collision"))
        shown = (f"{value:.1f} ({low:.1f} to {high:.1f})" for value, low, high in rates)
        rows.append([file.parent.name, str(test["rollouts"]), *shown])
    return StudyTable(
        f"{robot.title}: policies in the simulation that they were learned in",
        ("policy", "new scenarios", "success, %", "collisions, %"),
        rows,
        "in brackets 95 % intervals; nothing was chosen by these scenarios",
    )
