"""`swarmtwin experiment name=overview`: the whole pipeline on one page, and as tables in the terminal."""

import base64
from collections.abc import Sequence
from pathlib import Path
from typing import Any, Literal, NamedTuple

import pandas as pd
from jinja2 import Environment, PackageLoader
from rich.console import Console
from rich.table import Table

from swarmtwin.diagnosis.report.page import CAPTIONS, gain_bars, leading_pictures
from swarmtwin.diagnosis.report.sentences import verdict_words
from swarmtwin.diagnosis.result import DiagnosisResult
from swarmtwin.diagnosis.saved_diagnosis import RESULT, read_result
from swarmtwin.dynamics.model_folder import read_description
from swarmtwin.files import new_folder
from swarmtwin.robot import Robot, StrictModel
from swarmtwin.studies.dynamics.table import model_table
from swarmtwin.studies.synthetic.table import case_table
from swarmtwin.studies.transfer.table import policy_table
from swarmtwin.tracking import registry
from swarmtwin.transitions import Preparation, load_preparation


class Options(StrictModel):
    """Options; their defaults stand in conf/experiment/overview.yaml."""

    name: Literal["overview"]
    robots: tuple[str, ...]
    artifacts: Path
    output: Path
    overwrite: bool


class Chapter(NamedTuple):
    """What the pipeline made for one robot, as far as it has run.

    Attributes:
        robot: the robot.
        preparation: how its transitions came about.
        models: table.csv of the dynamics models compared.
        cases: table.csv of models trained on real and on synthetic transitions, None where they are not there yet.
        policies: table.csv of the policies rolled out, likewise.
        diagnosis: of a later session, likewise.
        report: the diagnosis's own page.
        champions: the promoted versions of each registered model, of policies one for each task.
        pictures: by section of the page, with their captions.
        films: with their captions.
    """

    robot: Robot
    preparation: Preparation
    models: pd.DataFrame
    cases: pd.DataFrame | None
    policies: pd.DataFrame | None
    diagnosis: DiagnosisResult | None
    report: Path
    champions: dict[str, list[registry.Version]]
    pictures: dict[str, dict[str, Path]]
    films: dict[str, Path]


PICTURES = {
    "models": {
        "transitions/{robot}/coverage.png": "What was recorded: the first runs, the commands, and the displacements "
        "that followed",
        "comparison/{robot}/errors_train_vehicle.png": "One-step errors on the vehicle that was learned from, on runs "
        "the models have not seen",
        "comparison/{robot}/errors_other_vehicle.png": "One-step errors on another vehicle of the same robot",
        "comparison/{robot}/runs_crnet.png": "CR-Net: whole runs predicted from the first pose and the commands alone",
    },
    "synthetic": {
        "real_and_synthetic/{robot}/errors.png": "One-step errors of models trained on real and on synthetic "
        "transitions, with all and with less of the real ones",
        "synthetic/{robot}/residual_diffusion/quality.png": "Transitions by residual diffusion, an ensemble's mean and "
        "diffused residuals, beside real ones",
        "synthetic/{robot}/gan/quality.png": "Transitions by the GAN as published beside real ones",
    },
    "policies": {
        "transfer/{robot}/success.png": "How often the policies succeed, in simulation and on stand-ins",
        "transfer/{robot}/rewards.png": "Each roll-out's reward in simulation and on stand-ins, from the same start",
        "transfer/{robot}/paths_{policy}.png": "{policy}: the paths of a typical roll-out",
    },
}
FILMS = {"transfer/{robot}/{policy}.mp4": "{policy}"}


def run(options: Options) -> dict[str, Any]:
    """Show the tables and write the page; return where it is.

    Raises:
        UserError: the pipeline has not run.
    """
    chapters = [_chapter(options.artifacts, robot) for robot in options.robots]
    with new_folder(options.output, "experiment", options.model_dump(mode="json"), options.overwrite) as folder:
        (folder / "overview.html").write_text(_page(chapters))
    console = Console()
    console.print(_recordings_table(chapters))
    for chapter in chapters:
        for warning in chapter.preparation.warnings:
            console.print(f"warning: {chapter.robot.name}: {warning}", highlight=False, soft_wrap=True)
    for chapter in chapters:
        console.print(model_table(chapter.robot.title, chapter.models).drawn())
    for chapter in chapters:
        if chapter.cases is not None:
            console.print(case_table(chapter.robot.title, chapter.cases).drawn())
    for chapter in chapters:
        if chapter.policies is not None:
            console.print(policy_table(chapter.robot.title, chapter.policies).drawn())
    for chapter in chapters:
        if chapter.diagnosis is not None:
            verdict = verdict_words(chapter.diagnosis)
            console.print(f"{chapter.robot.title}, a later session: {verdict}", highlight=False, soft_wrap=True)
            console.print(f"the whole diagnosis: {chapter.report}", highlight=False, soft_wrap=True)
    console.print(_registry_table(chapters))
    films = [film for chapter in chapters for film in chapter.films.values()]
    console.print(f"the same with pictures and films: {options.output / 'overview.html'}", highlight=False)
    if films:
        console.print(f"the films: {', '.join(map(str, films))}", highlight=False, soft_wrap=True)
    console.print("every run, to compare: make ui", highlight=False, soft_wrap=True)
    return {"output": str(options.output / "overview.html")}


def _chapter(artifacts: Path, robot_name: str) -> Chapter:
    comparison = artifacts / "comparison" / robot_name
    diagnosed = artifacts / "diagnosis" / robot_name
    policies = _table(artifacts / "transfer" / robot_name)
    names = [] if policies is None else list(policies.policy)
    diagnosis = read_result(diagnosed) if (diagnosed / RESULT).exists() else None
    leading = leading_pictures(diagnosis) if diagnosis else []
    pictures = {section: _drawn_files(artifacts, paths, robot_name, names) for section, paths in PICTURES.items()}
    found = {f"diagnosis/{{robot}}/figures/{name}.png": CAPTIONS[name] for name in leading}
    pictures["diagnosis"] = _drawn_files(artifacts, found, robot_name)
    return Chapter(
        robot=read_description(comparison / "best").robot,
        preparation=load_preparation(artifacts / "transitions" / robot_name),
        models=pd.read_csv(comparison / "table.csv"),
        diagnosis=diagnosis,
        report=_drawn(artifacts, f"diagnosis/{robot_name}/report.html"),
        cases=_table(artifacts / "real_and_synthetic" / robot_name),
        policies=policies,
        champions={
            name: registry.holders(name, "champion") for name in (f"{robot_name}-dynamics", f"{robot_name}-policy")
        },
        pictures=pictures,
        films=_drawn_files(artifacts, FILMS, robot_name, names),
    )


def _table(folder: Path) -> pd.DataFrame | None:
    file = folder / "table.csv"
    return pd.read_csv(file) if file.exists() else None


def _drawn(artifacts: Path, path: str) -> Path:
    """Return where a picture is: the pipeline draws into a folder of its own, a direct call beside its results."""
    file = artifacts / "pictures" / path
    return file if file.exists() else artifacts / path


def _drawn_files(
    artifacts: Path, captions: dict[str, str], robot: str, policies: Sequence[str] = ()
) -> dict[str, Path]:
    """Return what was drawn and is there, by its caption; what is drawn of policies once for each."""
    found = {}
    for path, caption in captions.items():
        for policy in policies if "{policy}" in path else ("",):
            file = _drawn(artifacts, path.format(robot=robot, policy=policy))
            if file.exists():
                found[caption.format(policy=policy)] = file
    return found


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
        for name, champions in chapter.champions.items():
            count = str(len(registry.versions(name)))
            if not champions:
                table.add_row(name, count, "none", "")
            for champion in champions:
                task = f" for {champion.task}" if champion.task else ""
                table.add_row(name, count, f"{champion.number}{task}", champion.tags.get("promoted_because", ""))
    return table


def _page(chapters: list[Chapter]) -> str:
    environment = Environment(loader=PackageLoader("swarmtwin.studies.overview", "."), autoescape=True)
    tables = {"model_table": model_table, "case_table": case_table, "policy_table": policy_table}
    environment.globals.update(tables)
    environment.filters.update(embedded=_embedded, verdict_words=verdict_words, gain_bars=gain_bars)
    return environment.get_template("page.html.jinja").render(chapters=chapters)


def _embedded(file: Path) -> str:
    """Return a picture's or film's content for a page that loads nothing."""
    kind = {".png": "image/png", ".mp4": "video/mp4"}[file.suffix]
    return f"data:{kind};base64,{base64.b64encode(file.read_bytes()).decode()}"
