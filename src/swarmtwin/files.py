"""Output folders and files that appear whole or not at all: written aside, then renamed."""

import contextlib
import fcntl
import json
import shutil
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from swarmtwin import __version__
from swarmtwin.errors import UserError

PROVENANCE = "provenance.json"


@contextlib.contextmanager
def new_folder(
    path: Path, command: str, config: dict[str, Any] | None = None, overwrite: bool = False, keep_partial: bool = False
) -> Iterator[Path]:
    """Give a folder beside `path` to write into; rename it to `path` when the block ends without an exception.

    Every folder made here holds `provenance.json` (command, version, config). `overwrite` replaces only a folder that
    holds one, so that nothing of the user's is ever deleted. With `keep_partial` an interrupted block leaves its
    unfinished folder aside and the next call continues in it: the caller keeps its checkpoints there.

    Raises:
        UserError: `path` is taken, or another process is writing it.
    """
    path = Path(path).absolute()
    _check_free(path, overwrite)
    path.parent.mkdir(parents=True, exist_ok=True)
    partial = path.with_name(f".{path.name}.partial")
    with _lock(path):
        if partial.exists() and not keep_partial:
            shutil.rmtree(partial)
        partial.mkdir(exist_ok=True)
        try:
            yield partial
            provenance = {"swarmtwin": __version__, "command": command, "config": config or {}}
            (partial / PROVENANCE).write_text(json.dumps(provenance, indent=1, default=str) + "\n")
            _replace_folder(partial, path)
        except BaseException:
            if not keep_partial:
                shutil.rmtree(partial, ignore_errors=True)
            raise


def write_text(path: Path, text: str) -> None:
    """Write a text file whole or not at all, replacing what `path` held."""
    aside = path.with_name(f".{path.name}.partial")
    try:
        aside.write_text(text)
        aside.replace(path)
    finally:
        aside.unlink(missing_ok=True)


def _check_free(path: Path, overwrite: bool) -> None:
    if path.is_file():
        raise UserError(f"output {path} is a file: name a folder")
    if not path.exists() or not any(path.iterdir()):
        return
    if not overwrite:
        raise UserError(f"output folder {path} already holds something: choose another, or add overwrite=true")
    if not (path / PROVENANCE).exists():
        raise UserError(f"output folder {path} was not made by swarmtwin, so overwrite=true leaves it alone")


@contextlib.contextmanager
def _lock(path: Path) -> Iterator[None]:
    lock_file = path.with_name(f".{path.name}.lock.partial")
    with lock_file.open("w") as handle:
        try:
            fcntl.flock(handle, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            raise UserError(f"another process is writing {path}: wait for it, or choose another output") from None
        try:
            yield
        finally:
            lock_file.unlink(missing_ok=True)


def _replace_folder(new: Path, path: Path) -> None:
    if not path.exists():
        new.replace(path)
        return
    old = path.with_name(f".{path.name}.old.partial")
    if old.exists():
        shutil.rmtree(old)
    path.replace(old)
    new.replace(path)
    shutil.rmtree(old)
