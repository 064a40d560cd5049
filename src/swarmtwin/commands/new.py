"""`swarmtwin new`: a lab's own project, which `dvc repro` runs outside of any checkout of swarmtwin."""

import re
import shutil
import subprocess
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Annotated, Any

import jinja2
from pydantic import Field
from rich.console import Console

from swarmtwin.configuration import config_files
from swarmtwin.errors import UserError
from swarmtwin.files import new_folder
from swarmtwin.recordings.reading import HEADER_FILE, read_recording
from swarmtwin.recordings.writing import write_recording
from swarmtwin.robot import Robot, Seed, StrictModel
from swarmtwin.standin.session import StandInSession, require_stand_in
from swarmtwin.studies.stand_in_recording import check_size, record

FIRST_RECORDING = Path("data/first_recording")


class Options(StrictModel):
    """Options of `swarmtwin new`; their defaults stand in conf/new.yaml."""

    robot: Robot
    name: Annotated[str, Field(pattern=r"^[a-z][a-z0-9_]*$")]
    recording: Path | None
    runs: Annotated[int, Field(ge=8)]
    steps: Annotated[int, Field(ge=1)]
    seed: Seed
    output: Path


def run(options: Options) -> dict[str, Any]:
    """Lay the project out, and say what to do next.

    Raises:
        UserError: the folder holds something already, the name is another robot's, the recording cannot be read, or
            there is neither a recording nor a stand-in.
    """
    if options.name in config_files("robot"):
        raise UserError(f"name={options.name} is a robot that swarmtwin brings: give the lab's own another name")
    own = options.robot.model_copy(update={"name": options.name})
    settings = options.model_dump(mode="json")
    inputs = [options.recording] if options.recording else []
    with new_folder(options.output, "new", settings, inputs=inputs) as folder:
        (folder / FIRST_RECORDING).mkdir(parents=True)
        origin = _copy_recording(options, own, folder) if options.recording else _drive(options, own, folder)
        _write_files(options, folder, origin)
        _put_under_control(folder)
    console = Console(highlight=False)
    for line in (f"{options.output}: {origin}", f"next: cd {options.output} && dvc repro", "README.md there says more"):
        console.print(line, soft_wrap=True)
    return {"output": str(options.output)}


def _drive(options: Options, own: Robot, folder: Path) -> str:
    """Let a stand-in of the robot drive; return where the recording comes from, in a sentence."""
    require_stand_in(options.robot)
    check_size(options.runs, options.steps, 1)
    session = StandInSession(options.robot, ("1",), options.runs, options.steps, options.seed)
    _, recording = record(session)
    header = recording.header.model_copy(update={"robot": own.name})
    write_recording(folder / FIRST_RECORDING, own, header, recording.tracks, "parquet")
    return (
        f"Its first recording, {options.runs} runs of {options.steps * own.period_s:g} s, was driven by a stand-in, a "
        f"simulated {options.robot.title}: replace it when you have recorded your own."
    )


def _copy_recording(options: Options, own: Robot, folder: Path) -> str:
    """Copy a recording, in which the robot is called by its new name; return where it comes from, in a sentence."""
    assert options.recording is not None
    target = folder / FIRST_RECORDING
    shutil.copytree(options.recording, target, dirs_exist_ok=True)
    file = target / HEADER_FILE
    if file.is_file():
        file.write_text(re.sub(r"(?m)^robot:.*$", f"robot: {own.name}", file.read_text()))
    recording = read_recording(target, own)
    return f"Its first recording, {len(recording.runs)} runs, is a copy of {options.recording.name}."


def _write_files(options: Options, folder: Path, origin: str) -> None:
    """Write the robot's file, the pipeline and the README."""
    text = config_files("robot")[options.robot.name].read_text()
    text = re.sub(r"(?m)^name:.*$", f"name: {options.name}", text, count=1)
    text = re.sub(
        r"\A#.*$", f"# Ours. At first all values are those of {options.robot.name}.", text, flags=re.MULTILINE
    )
    (folder / "conf" / "robot").mkdir(parents=True)
    (folder / "conf" / "robot" / f"{options.name}.yaml").write_text(text)
    project = options.output.absolute().name
    experiments = re.sub(r"[^\w.-]+", "_", project)  # a word for shell, YAML and MLflow
    told = {"robot": options.name, "project": project, "experiments": experiments, "origin": origin}
    environment = jinja2.Environment(undefined=jinja2.StrictUndefined, keep_trailing_newline=True, autoescape=False)
    for file in sorted((Path(__file__).parent / "project_files").iterdir()):
        (folder / file.name.removesuffix(".jinja")).write_text(environment.from_string(file.read_text()).render(told))


def _put_under_control(folder: Path) -> None:
    """Make the folder a repository of git's, where there is git, and a project of DVC's that keeps the recording."""
    if shutil.which("git"):
        _call(["git", "init", "--quiet"], folder)
        _call([sys.executable, "-m", "dvc", "init", "--quiet"], folder)
    else:
        _call([sys.executable, "-m", "dvc", "init", "--quiet", "--no-scm"], folder)
    _call([sys.executable, "-m", "dvc", "config", "core.analytics", "false"], folder)
    _call([sys.executable, "-m", "dvc", "add", "--quiet", "data"], folder)


def _call(command: Sequence[str], folder: Path) -> None:
    answer = subprocess.run(command, cwd=folder, capture_output=True, text=True, check=False)
    if answer.returncode:
        said = (answer.stderr.strip() or answer.stdout.strip() or "no reason was given").splitlines()[-1]
        raise UserError(f"{' '.join(command[-4:])} failed in the new folder ({said}): see swarmtwin doctor")
