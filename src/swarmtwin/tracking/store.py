"""The MLflow store: where it is, whether it can be used, and one process at a time where that matters."""

import contextlib
import errno
import fcntl
import logging
import os
import sqlite3
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from functools import cache
from pathlib import Path

os.environ.setdefault("MLFLOW_DISABLE_TELEMETRY", "true")
os.environ.setdefault("MLFLOW_LOGGING_LEVEL", "WARNING")
os.environ.setdefault("MLFLOW_HTTP_REQUEST_MAX_RETRIES", "2")  # seven take four minutes

import mlflow
import requests
from mlflow.exceptions import MlflowException
from sqlalchemy.exc import SQLAlchemyError

from swarmtwin.errors import UserError


@contextmanager
def store_errors() -> Iterator[None]:
    """Turn a failure of the tracking store into one clear message; also a decorator.

    A full disk is none of the store's faults, and passes.
    """
    try:
        yield
    except (MlflowException, SQLAlchemyError, requests.RequestException, OSError) as error:
        if isinstance(error, OSError) and error.errno in (errno.ENOSPC, errno.EDQUOT):
            raise
        uri, reason = store_uri(), str(error).strip().splitlines()[0]
        check = "start its server" if uri.startswith("http") else "see that its folder is there and can be written"
        remedy = f"{check}, or set MLFLOW_TRACKING_URI to another"
        raise UserError(f"the MLflow store {uri} cannot be used ({reason}): {remedy}") from error


def store_uri() -> str:
    """Return where MLflow keeps runs and models: `MLFLOW_TRACKING_URI`, or else `mlflow.db` in this folder.

    For an experiment that DVC runs in a copy of the repository, it is that of the repository itself.
    """
    folder = Path(os.environ.get("DVC_ROOT") or Path.cwd())
    return os.environ.get("MLFLOW_TRACKING_URI") or f"sqlite:///{folder / 'mlflow.db'}"


def use_store() -> None:
    """Point MLflow at its store, and let it speak up only when something is wrong.

    Raises:
        UserError: the store cannot be used: its server does not answer within seconds, its folder is not there.
    """
    logging.getLogger("mlflow").setLevel(logging.WARNING)
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
        experiments = mlflow.MlflowClient().search_experiments()
        if database := _database():
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
    names = [name for name, location in locations.items() if location.endswith(f"/mlruns/{name}")]
    came_with = {locations[name].removesuffix(f"/{name}") for name in names if (here / name).is_dir()}
    for there in came_with - {here.as_uri()}:
        with contextlib.suppress(sqlite3.OperationalError), contextlib.closing(sqlite3.connect(database)) as connection:
            for table, columns in places.items():
                for column in columns:
                    moved = f"UPDATE {table} SET {column} = ? || substr({column}, ?) WHERE substr({column}, 1, ?) = ?"
                    start = len(there) + 1
                    connection.execute(moved, (here.as_uri(), start, start, f"{there}/"))
            connection.commit()


def use_experiment(name: str) -> None:
    """Let runs belong to an experiment of MLflow's, made if need be; beside a database file, files lie in `mlruns/`.

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
    if database and database.exists() and not os.access(database, os.W_OK):
        with store_errors():
            raise PermissionError(errno.EACCES, "its file cannot be written", str(database))


@contextmanager
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
