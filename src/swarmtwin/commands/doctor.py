"""`swarmtwin doctor`: what this machine has and what it lacks, one line each, with what to do about it."""

import configparser
import os
import platform
import shutil
from collections.abc import Iterator
from importlib.metadata import PackageNotFoundError, metadata, version
from pathlib import Path
from typing import Annotated, Any, Literal, NamedTuple

from packaging.specifiers import SpecifierSet
from pydantic import Field
from rich.console import Console
from rich.text import Text

from swarmtwin.errors import UserError
from swarmtwin.extras import Extra, install_command, missing_packages, requirements
from swarmtwin.strict_model import StrictModel

State = Literal["good", "noted", "lacking"]
"""Of something looked at: it is there; it is not, which matters to some; it is not, and something here needs it."""

MARKS: dict[State, tuple[str, str]] = {"good": ("✓", "green"), "noted": ("–", "yellow"), "lacking": ("✗", "red")}


class Options(StrictModel):
    """Options of `swarmtwin doctor`; their defaults stand in conf/doctor.yaml."""

    needs: tuple[Extra, ...] | None
    least_free_gb: Annotated[float, Field(ge=0)]


class Finding(NamedTuple):
    """What was found of one thing: its name, how it is, and in words what it is or what to do."""

    name: str
    state: State
    words: str


def run(options: Options) -> dict[str, Any]:
    """Show what was found, a line each, and return how many there are of each state.

    Raises:
        UserError: something is lacking.
    """
    needed = _needed(options.needs)
    found = [
        _python(),
        *_parts(needed),
        *(_learning() if "train" in needed else ()),
        *(_robots() if "deploy" in needed else ()),
        *_history(),
        _mlflow_store(),
        _disk(options.least_free_gb),
        _processors(),
    ]
    console = Console(highlight=False)
    for name, state, words in found:
        mark, colour = MARKS[state]
        console.print(Text.assemble((mark, colour), f" {name:<14}{words}"), soft_wrap=True)
    lacking = [one.name for one in found if one.state == "lacking"]
    if lacking:
        raise UserError(f"lacking: {', '.join(lacking)}; the lines above say what to do")
    return {state: sum(one.state == state for one in found) for state in MARKS}


def _needed(asked: tuple[Extra, ...] | None) -> tuple[Extra, ...]:
    """Return what must be there: what is asked for, or those of `deploy` and `train` that are whole, or `train`."""
    if asked is not None:
        return asked
    whole: tuple[Extra, ...] = tuple(part for part in ("deploy", "train") if not missing_packages(part))
    return whole or ("train",)


def _python() -> Finding:
    try:
        asked = metadata("swarmtwin")["Requires-Python"] or ""
    except PackageNotFoundError:  # imported from its sources
        asked = ""
    if SpecifierSet(asked).contains(platform.python_version()):
        return Finding("Python", "good", platform.python_version())
    return Finding(
        "Python", "lacking", f"{platform.python_version()} is not {asked}: make the environment with another"
    )


def _parts(needed: tuple[Extra, ...]) -> Iterator[Finding]:
    """Say of each part whether it is whole: what is lacking of one that is needed must be installed."""
    parts: tuple[Extra, ...] = ("base", "deploy", "tracking", "train", "studies", "slurm", "ray", "postgresql", "s3")
    for part in parts:
        missing = missing_packages(part)
        name = f"[{part}]"
        if not missing:
            yield Finding(name, "good", f"{len(requirements(part))} packages")
            continue
        told = [f"{one} {found} is another version" if found else one for one, found in sorted(missing.items())]
        words = ", ".join([*told[:4], *(["..."] if told[4:] else [])])
        yield Finding(
            name, "lacking" if part in needed or part == "base" else "noted", f"{words}: {install_command(part)}"
        )


def _learning() -> Iterator[Finding]:
    try:
        built = version("torch")
    except PackageNotFoundError:
        return  # told of with its part
    import torch

    if torch.cuda.is_available():
        yield Finding("torch", "good", f"{built}, with {torch.cuda.get_device_name()}: device=auto takes it")
    elif "+cpu" in built:
        yield Finding("torch", "good", f"{built}, for the CPU; there is no GPU that it could use, nor need there be")
    else:
        remedy = "pip install torch --index-url https://download.pytorch.org/whl/cpu saves gigabytes"
        yield Finding("torch", "noted", f"{built} finds no GPU: {remedy}")


def _robots() -> Iterator[Finding]:
    if broker := shutil.which("mosquitto", path=f"{os.environ.get('PATH', '')}:/usr/sbin"):
        yield Finding("MQTT broker", "good", broker)
    else:
        yield Finding(
            "MQTT broker", "noted", "no mosquitto: apt install mosquitto; for a first try, fleet broker=embedded"
        )
    cameras = sorted(Path("/dev").glob("video*"))
    closed = [camera for camera in cameras if not os.access(camera, os.R_OK | os.W_OK)]
    if closed:
        yield Finding(
            "camera", "lacking", f"{closed[0]} may not be opened: sudo usermod -aG video $USER, then log in anew"
        )
    elif cameras:
        yield Finding("camera", "good", ", ".join(map(str, cameras)))
    else:
        words = "none in /dev/video*: plug one in, or give camera=http://HOST:PORT/camera; fleet has an emulated one"
        yield Finding("camera", "noted", words)


def _history() -> Iterator[Finding]:
    """Say whether what is done here can be found again: by git, and by DVC with a remote."""
    if not shutil.which("git"):
        yield Finding("git", "noted", "not there, so that runs do not know their commit: apt install git")
        return
    here = [Path.cwd(), *Path.cwd().parents]
    inside = next((folder for folder in here if (folder / ".git").exists()), None)
    yield (
        Finding("git", "good", f"repository {inside}")
        if inside
        else Finding("git", "noted", f"{Path.cwd()} is in no repository: git init, so that runs know their commit")
    )
    project = next((folder for folder in here if (folder / ".dvc").is_dir()), None)
    if project is None:
        yield Finding("DVC", "noted", f"{Path.cwd()} is in no project: swarmtwin new NAME lays one out")
        return
    yield _remote(project)


def _remote(project: Path) -> Finding:
    """Say where DVC pushes to: its configurations are INI files, of which the local one goes first."""
    read = configparser.ConfigParser(interpolation=None)
    read.read([project / ".dvc" / "config", project / ".dvc" / "config.local"])
    name = read.get("core", "remote", fallback=None)
    url = read.get(f"'remote \"{name}\"'", "url", fallback=None)
    if url is None:
        words = f"{project} has no remote: dvc remote add -d store s3://BUCKET/FOLDER, or ssh://, or a folder"
        return Finding("DVC remote", "noted", words)
    if "://" not in url and not (project / ".dvc" / url).exists():
        return Finding("DVC remote", "lacking", f"{name}: there is no folder {(project / '.dvc' / url).resolve()}")
    return Finding("DVC remote", "good", f"{name}, {url}")


def _mlflow_store() -> Finding:
    """Say whether runs can be kept; a database that is not there yet is not made."""
    if missing_packages("tracking"):
        return Finding("MLflow store", "noted", f"MLflow is not here, runs are not kept: {install_command('tracking')}")
    from swarmtwin.tracking.store import is_new, store_uri, use_store

    uri = store_uri()
    if is_new():
        return Finding("MLflow store", "good", f"{uri}, made with the first run")
    try:
        use_store()
    except UserError as error:
        return Finding("MLflow store", "lacking", str(error))
    return Finding("MLflow store", "good", uri)


def _disk(least_free_gb: float) -> Finding:
    free_gb = shutil.disk_usage(Path.cwd()).free / 1e9
    if free_gb < least_free_gb:
        return Finding(
            "disk", "lacking", f"{free_gb:.1f} GB are free, less than least_free_gb={least_free_gb:g}: make room"
        )
    return Finding("disk", "good", f"{free_gb:.0f} GB are free")


def _processors() -> Finding:
    cores = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
    memory_gb = os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES") / 1e9
    state: State = "good" if cores > 1 and memory_gb > 3 else "noted"
    advice = "" if state == "good" else "; the pipeline wants two cores and 3 GB"
    return Finding("processor", state, f"cores: {cores}, memory: {memory_gb:.0f} GB{advice}")
