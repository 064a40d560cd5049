"""Output folders and files that appear whole or not at all: written aside, then renamed."""

import contextlib
import fcntl
import hashlib
import json
import logging
import os
import shutil
from collections.abc import Iterator, Sequence
from itertools import count
from pathlib import Path
from typing import Any

from swarmtwin import __version__
from swarmtwin.errors import UserError

PROVENANCE = "provenance.json"
CHECKPOINTS = "checkpoints"

log = logging.getLogger(__name__)


@contextlib.contextmanager
def new_folder(
    path: Path,
    command: str,
    config: dict[str, Any] | None = None,
    overwrite: bool = False,
    resumable: bool = False,
    inputs: Sequence[Path] = (),
) -> Iterator[Path]:
    """Give a folder beside `path` to write into; rename it to `path` when the block ends without an exception.

    Every folder made here holds `provenance.json` (command, version, config), from the beginning of the block on.
    `overwrite` replaces only a folder that the same command made, so that nothing else of the user's is ever deleted.
    A `resumable` block finds what an interrupted one left in the folder's `checkpoints/`, and nothing else of it; that
    folder is no part of the output. What is tracked and registered within the block is so before the output appears.

    Raises:
        UserError: `path` is taken, lies in or around one of the `inputs`, or another process is writing it.
        KeyboardInterrupt: with what it says if the block's work can be continued.
    """
    path = Path(path).absolute()
    _check_place(path, inputs)
    path.parent.mkdir(parents=True, exist_ok=True)
    partial = path.with_name(f".{path.name}.partial")
    with _lock(path):
        _restore_interrupted_replacement(path)
        check_output(path, command, overwrite)
        try:
            _clear(partial, keep=resumable)
            provenance = {"swarmtwin": __version__, "command": command, "config": config or {}}
            (partial / PROVENANCE).write_text(json.dumps(provenance, indent=1, default=str) + "\n")
            if resumable and _holds_work(partial):
                log.info("%s: goes on with what an interrupted call has left", path)
            yield partial
            shutil.rmtree(partial / CHECKPOINTS, ignore_errors=True)
            _replace_folder(partial, path)
        except BaseException as error:
            kept = resumable and _holds_work(partial)
            if not kept:
                shutil.rmtree(partial, ignore_errors=True)
            if path.is_dir() and not any(path.iterdir()):
                path.rmdir()
            if kept and isinstance(error, KeyboardInterrupt):
                raise KeyboardInterrupt(f"what was done is kept, the same call with output={path} goes on") from None
            raise


def _clear(partial: Path, keep: bool) -> None:
    """Empty the folder that a kill may have left, or make it; its checkpoints may stay."""
    for left in partial.glob("*"):
        if left.is_dir() and not (keep and left.name == CHECKPOINTS):
            shutil.rmtree(left)
        elif not left.is_dir():
            left.unlink()
    (partial / CHECKPOINTS if keep else partial).mkdir(parents=True, exist_ok=True)


def _holds_work(partial: Path) -> bool:
    return any((partial / CHECKPOINTS).glob("*"))


def write_text(path: Path, text: str) -> None:
    """Write a text file whole or not at all, replacing what `path` held."""
    with whole_file(path) as aside:
        aside.write_text(text)


def _umask() -> int:
    """Return which permissions new files do not get; there is no way to ask but to set it."""
    mask = os.umask(0o022)
    os.umask(mask)
    return mask


@contextlib.contextmanager
def whole_file(path: Path) -> Iterator[Path]:
    """Give a path beside `path` to write to; it replaces `path` when the block ends without an exception."""
    aside = path.with_name(f".{path.name}.partial")
    try:
        yield aside
        aside.chmod(0o666 & ~_umask())  # safetensors writes files that nobody else can read
        aside.replace(path)
    finally:
        aside.unlink(missing_ok=True)


def check_regular(path: Path) -> None:
    """Check that what lies at a path, if anything does, is a file or a folder: a pipe or a device is read for ever.

    Raises:
        UserError: it is something else.
    """
    if path.exists() and not path.is_file() and not path.is_dir():
        raise UserError(f"{path} is no regular file: put a copy of the file's content there")


def check_holds(folder: Path, file: str, holds: str, made_by: str) -> None:
    """Check that a folder is one of those that the command `made_by` makes, by the `file` that describes what it holds.

    Raises:
        UserError: there is no such file.
    """
    if not (folder / file).exists():
        raise UserError(f"no {holds} in {folder}: {file} is missing; name a folder that {made_by} made")


def folder_digest(folder: Path) -> str:
    """Return a digest of what makes a model folder that model: its weights and its description."""
    content = hashlib.sha256()
    for file in sorted(folder.iterdir()):
        if file.suffix in (".safetensors", ".yaml", ".onnx"):
            content.update(file.name.encode() + b"\0" + file.read_bytes())
    return content.hexdigest()[:16]


def check_output(path: Path, command: str, overwrite: bool, inputs: Sequence[Path] = ()) -> None:
    """Check that `command` may write its output folder to `path`.

    Raises:
        UserError: it may not: see `new_folder`.
    """
    _check_place(path, inputs)
    if not path.exists() or not any(path.iterdir()):
        return
    if not overwrite:
        raise UserError(f"output folder {path} already holds something: choose another, or add overwrite=true")
    made_by = _made_by(path)
    if made_by is None:
        raise UserError(f"output folder {path} was not made by swarmtwin, so overwrite=true leaves it alone")
    if made_by != command:
        raise UserError(f"output folder {path} was made by swarmtwin {made_by}, so overwrite=true leaves it alone")


def _check_place(path: Path, inputs: Sequence[Path]) -> None:
    """Check that a folder can be at `path`, apart from the inputs."""
    for folder in inputs:
        _check_apart(path, folder)
    for place in (path, *path.parents):
        if place.exists() and not place.is_dir():
            raise UserError(f"output {path}: {place} is not a folder: name another")


def _check_apart(output: Path, given: Path) -> None:
    """Check that an output would neither replace an input nor change what it holds."""
    output, given = output.resolve(), given.resolve()
    if given.is_relative_to(output):
        raise UserError(f"output {output} would replace the input {given}: choose another folder")
    if output.is_relative_to(given):
        raise UserError(f"output {output} would lie inside the input {given}: choose another folder")


def read_provenance(folder: Path) -> tuple[str, dict[str, Any]]:
    """Return the command that made a folder, and its options.

    Raises:
        UserError: the folder is not there, or was not made by swarmtwin.
    """
    check_regular(folder / PROVENANCE)
    try:
        content = json.loads((folder / PROVENANCE).read_text())
        return str(content["command"]), dict(content["config"])
    except (OSError, ValueError, KeyError, TypeError):
        raise UserError(f"{folder} was not made by swarmtwin: name an output folder of one of its commands") from None


def _made_by(folder: Path) -> str | None:
    with contextlib.suppress(UserError):
        return read_provenance(folder)[0]
    return None


@contextlib.contextmanager
def _lock(path: Path) -> Iterator[None]:
    lock_file = path.with_name(f".{path.name}.lock.partial")
    while True:
        with lock_file.open("w") as handle:
            try:
                fcntl.flock(handle, fcntl.LOCK_EX | fcntl.LOCK_NB)
            except BlockingIOError:
                raise UserError(f"another process is writing {path}: wait for it, or choose another output") from None
            if not _is_still(lock_file, handle.fileno()):  # its holder removed it just before it was ours
                continue
            try:
                yield
            finally:
                lock_file.unlink(missing_ok=True)
            return


def _is_still(path: Path, descriptor: int) -> bool:
    """Return whether a path leads to the file that is open."""
    try:
        return os.path.samestat(path.stat(), os.fstat(descriptor))
    except FileNotFoundError:
        return False


def _former(path: Path) -> Path:
    return path.with_name(f".{path.name}.former.partial")


def _replace_folder(new: Path, path: Path) -> None:
    if path.exists():
        path.replace(_former(path))
    new.replace(path)
    shutil.rmtree(_former(path), ignore_errors=True)


def _restore_interrupted_replacement(path: Path) -> None:
    """Put the former output back, should a kill have come between the two renames of its replacement."""
    former = _former(path)
    if former.exists() and not path.exists():
        former.replace(path)
    shutil.rmtree(former, ignore_errors=True)


def output_folder(chosen: Path | None, command: str, name: str) -> Path:
    """Return the folder asked for, or claim the first free `outputs/<command>/<name>-<number>` by making it, empty."""
    if chosen is not None:
        return chosen
    for number in count(1):
        folder = Path("outputs") / command / f"{name}-{number:03}"
        try:
            folder.mkdir(parents=True)
        except FileExistsError:
            continue
        return folder
    raise AssertionError
