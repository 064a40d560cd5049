"""The MLflow store: where it is, whether it can be used, and one process at a time where that matters."""

import contextlib
import errno
import fcntl
import logging
import os
import sqlite3
from collections.abc import Iterator, Mapping
from functools import cache
from pathlib import Path
from urllib.parse import quote

os.environ.setdefault("MLFLOW_DISABLE_TELEMETRY", "true")
os.environ.setdefault("MLFLOW_LOGGING_LEVEL", "WARNING")
os.environ.setdefault("MLFLOW_HTTP_REQUEST_MAX_RETRIES", "2")  # seven take four minutes

import mlflow
import requests
from mlflow.exceptions import MlflowException
from sqlalchemy.exc import SQLAlchemyError

from swarmtwin.errors import UserError
from swarmtwin.files import whole_file

PROJECT = "SWARMTWIN_PROJECT"
"""The environment variable that says whose runs these are on a server that several projects share."""


@contextlib.contextmanager
def store_errors() -> Iterator[None]:
    """Turn a failure of the tracking store into one clear message; also a decorator.

    A full disk is none of the store's faults: it is an `OSError`, also where SQLite tells of it.
    """
    try:
        yield
    except (MlflowException, SQLAlchemyError, sqlite3.Error, requests.RequestException, OSError) as error:
        if isinstance(error, OSError) and error.errno in (errno.ENOSPC, errno.EDQUOT):
            raise
        lines = str(error).strip().splitlines() or [type(error).__name__]
        if any("disk is full" in line for line in lines):
            raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC), str(_database())) from error
        uri, reason = store_uri(), next((line for line in lines if line.startswith("(sqlite3.")), lines[0])
        check = "start its server" if uri.startswith("http") else "see that its folder is there and can be written"
        remedy = f"{check}, or set MLFLOW_TRACKING_URI to another"
        raise UserError(f"the MLflow store {uri} cannot be used ({reason}): {remedy}") from error


def store_uri() -> str:
    """Return where MLflow keeps runs and models: `MLFLOW_TRACKING_URI`, or else `mlflow.db` in this folder.

    For an experiment that DVC runs in a copy of the repository, it is that of the repository itself.
    """
    folder = Path(os.environ.get("DVC_ROOT") or Path.cwd())
    return os.environ.get("MLFLOW_TRACKING_URI") or f"sqlite:///{folder / 'mlflow.db'}"


def is_new() -> bool:
    """Say whether the store is a database file that is yet to be made."""
    database = _database()
    return database is not None and not (database.exists() and database.stat().st_size)


def use_store() -> None:
    """Point MLflow at its store, and let it speak up only when something is wrong.

    Raises:
        UserError: the store cannot be used: its server does not answer within seconds, its folder is not there.
    """
    logging.getLogger("mlflow").setLevel(logging.WARNING)
    logging.getLogger("mlflow.store.db.utils").setLevel(logging.CRITICAL)  # shows a traceback of what is told in a line
    uri = store_uri()
    with store_errors():
        mlflow.set_tracking_uri(uri)
        _open_store(uri)


@cache
def _open_store(uri: str) -> None:
    """See once a process that the store answers; a new database is made by one process, while others wait."""
    if uri.startswith("http"):
        requests.get(f"{uri.rstrip('/')}/health", timeout=5)  # any answer will do
        return
    with store_lock():
        database = _database()
        if database and is_new():
            _make_database(database)
        experiments = mlflow.MlflowClient().search_experiments()
        if database:
            _follow_moved_files(database, {experiment.name: experiment.artifact_location for experiment in experiments})


def _follow_moved_files(database: Path, locations: Mapping[str, str]) -> None:
    """Let MLflow find its files where the database was moved or copied together with the `mlruns/` beside it.

    MLflow keeps absolute places. Those in the folder that a database came from become the same places beside it; a
    database that cannot be written stays as it is.

    Args:
        database: the file.
        locations: where the files of each experiment are kept, by its name.
    """
    here = database.parent / "mlruns"
    places = {
        "experiments": ("artifact_location",),
        "runs": ("artifact_uri",),
        "logged_models": ("artifact_location",),
        "model_versions": ("source", "storage_location"),
    }
    ends = {name: f"/{quote(name)}" for name in locations if (here / name).is_dir()}
    came_with = {
        locations[name].removesuffix(end) for name, end in ends.items() if locations[name].endswith(f"/mlruns{end}")
    }
    for there in came_with - {here.as_uri()}:
        with contextlib.suppress(sqlite3.OperationalError), contextlib.closing(sqlite3.connect(database)) as connection:
            for table, columns in places.items():
                for column in columns:
                    moved = f"UPDATE {table} SET {column} = ? || substr({column}, ?) WHERE substr({column}, 1, ?) = ?"
                    start = len(there) + 1
                    connection.execute(moved, (here.as_uri(), start, start, f"{there}/"))
            connection.commit()


def _make_database(database: Path) -> None:
    """Make MLflow's tables aside, to appear whole: with half of them, as a kill leaves, MLflow cannot go on."""
    with whole_file(database) as aside:
        for left in (aside, aside.with_name(f"{aside.name}-journal")):
            left.unlink(missing_ok=True)
        aside.touch()  # where that cannot be done, MLflow would try for minutes
        mlflow.MlflowClient(f"sqlite:///{aside}").search_experiments(max_results=1)


def experiment_name(kind: str) -> str:
    """Return what MLflow calls an experiment: `swarmtwin/dynamics`, or after the project in `SWARMTWIN_PROJECT`."""
    return f"{os.environ.get(PROJECT) or 'swarmtwin'}/{kind}"


def use_experiment(name: str) -> None:
    """Let runs belong to an experiment of MLflow's, made if need be; beside a database file, files lie in `mlruns/`.

    Args:
        name: as `experiment_name` makes it.

    Raises:
        UserError: the store cannot be used.
    """
    with store_errors():
        use_store()
        check_writable()
        with store_lock():
            database = _database()
            if database and mlflow.get_experiment_by_name(name) is None:
                mlflow.create_experiment(name, (database.parent / "mlruns" / name).as_uri())
            mlflow.set_experiment(name)


def check_writable() -> None:
    """Check that the database file of the store, if it is one, can be written: MLflow would try for minutes.

    Raises:
        UserError: it cannot.
    """
    database = _database()
    if database and database.exists():
        with store_errors(), contextlib.closing(sqlite3.connect(database, timeout=60)) as connection:
            connection.execute("BEGIN IMMEDIATE")
            connection.execute("CREATE TABLE probe (id)")  # not kept: nothing is committed


@contextlib.contextmanager
def store_lock() -> Iterator[None]:
    """Let one process at a time do what takes several steps, where the store is a database file; else do not wait."""
    database = _database()
    if database is None:
        yield
        return
    try:
        handle = database.with_name(f".{database.name}.lock.partial").open("w")
    except OSError:  # a folder that cannot be written: whoever reads needs no lock
        yield
        return
    with handle:
        fcntl.flock(handle, fcntl.LOCK_EX)
        yield


def _database() -> Path | None:
    uri = store_uri()
    return Path(uri.removeprefix("sqlite:///").partition("?")[0]).absolute() if uri.startswith("sqlite:///") else None
