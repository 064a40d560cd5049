"""`swarmtwin experiment name=overview`: the whole pipeline on one page, and as tables in the terminal."""

import base64
from pathlib import Path
from typing import Literal, NamedTuple

import pandas as pd
from jinja2 import Environment, PackageLoader
from rich.console import Console
from rich.table import Table

from swarmtwin import registry
from swarmtwin.commands.experiments.model_table import ModelRow, model_rows, model_table
from swarmtwin.dynamics.store import read_description
from swarmtwin.errors import UserError
from swarmtwin.files import new_folder
from swarmtwin.robot import Robot, StrictModel
from swarmtwin.transitions import Preparation, load_preparation


class Options(StrictModel):
    """Options; their defaults stand in conf/experiment/overview.yaml."""

    name: Literal["overview"]
    robots: tuple[str, ...]
    artifacts: Path
    output: Path
    overwrite: bool


class Chapter(NamedTuple):
    """What the pipeline made for one robot: its transitions, the models compared, the best of them, the champion."""

    robot: Robot
    preparation: Preparation
    table: pd.DataFrame
    best: str
    champion: registry.Version | None
    pictures: dict[str, Path]

    @property
    def rows(self) -> list[ModelRow]:
        """The models as a person reads them, the floor first."""
        return model_rows(self.table)


PICTURES = {
    "coverage": "What was recorded: the first runs, the commands, and the displacements that followed",
    "errors_train_vehicle": "One-step errors on the vehicle that was learned from, on runs the models have not seen",
    "errors_other_vehicle": "One-step errors on another vehicle of the same robot",
    "runs_crnet": "CR-Net: whole runs predicted from the first pose and the commands alone",
}


def run(options: Options) -> None:
    """Show the tables and write the page.

    Raises:
        UserError: the pipeline has not run.
    """
    chapters = [_chapter(options.artifacts, robot) for robot in options.robots]
    with new_folder(options.output, "experiment", options.model_dump(mode="json"), options.overwrite) as folder:
        (folder / "overview.html").write_text(_page(chapters))
    console = Console()
    console.print(_recordings_table(chapters))
    for chapter in chapters:
        console.print(model_table(chapter.robot.title, chapter.table, chapter.best))
    console.print(_registry_table(chapters))
    console.print(f"the same with pictures: {options.output / 'overview.html'}", highlight=False, soft_wrap=True)
    console.print("every run, to compare: make ui", highlight=False, soft_wrap=True)


def _chapter(artifacts: Path, robot_name: str) -> Chapter:
    comparison = artifacts / "comparison" / robot_name
    if not (comparison / "table.csv").exists():
        raise UserError(f"{comparison} holds no comparison of models: run `dvc repro` first")
    folders = (artifacts / "transitions" / robot_name, comparison)
    best = read_description(comparison / "best")
    return Chapter(
        robot=best.robot,
        preparation=load_preparation(folders[0]),
        table=pd.read_csv(comparison / "table.csv"),
        best=best.model["name"],
        champion=registry.champion(f"{robot_name}-dynamics"),
        pictures={name: folder / f"{name}.png" for name in PICTURES for folder in folders if _holds(folder, name)},
    )


def _holds(folder: Path, picture: str) -> bool:
    return (folder / f"{picture}.png").exists()


def _recordings_table(chapters: list[Chapter]) -> Table:
    table = Table("robot", "recorded", "transitions kept", "dropped", "train / validation / test", title="Recordings")
    for chapter in chapters:
        counts = chapter.preparation.counts
        dropped = ", ".join(f"{reason} {number}" for reason, number in counts.dropped.items())
        splits = " / ".join(str(number) for number in chapter.preparation.transitions.values())
        vehicles = ", ".join(chapter.preparation.vehicles)
        table.add_row(chapter.robot.name, f"vehicle {vehicles}", f"{counts.kept:,}", dropped or "none", splits)
    return table


def _registry_table(chapters: list[Chapter]) -> Table:
    table = Table("registered model", "versions", "champion", "why", title="Registry")
    for chapter in chapters:
        name = f"{chapter.robot.name}-dynamics"
        champion = chapter.champion
        reason = champion.tags.get("promoted_because", "") if champion else ""
        table.add_row(name, str(len(registry.versions(name))), str(champion.number) if champion else "none", reason)
    return table


def _page(chapters: list[Chapter]) -> str:
    template = Environment(loader=PackageLoader("swarmtwin.commands.experiments", "."), autoescape=True)
    pictures = {
        chapter.robot.name: {
            PICTURES[name]: base64.b64encode(path.read_bytes()).decode() for name, path in chapter.pictures.items()
        }
        for chapter in chapters
    }
    return template.get_template("overview.html.jinja").render(chapters=chapters, pictures=pictures)
