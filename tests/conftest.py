import os
import shutil
import signal
from pathlib import Path

import pytest

os.environ.setdefault("OMP_NUM_THREADS", "1")
os.environ["MLFLOW_DISABLE_TELEMETRY"] = "true"

if signal.getsignal(signal.SIGINT) is signal.SIG_IGN:  # in the background of a script; what tests start inherits it
    signal.signal(signal.SIGINT, signal.default_int_handler)

REPOSITORY = Path(__file__).resolve().parents[1]


LONGEST = ("test_diagnose.py", "test_pipeline.py", "test_outside.py")


def pytest_collection_modifyitems(items):
    """Let the longest modules begin first, each in a part of its own: as many workers take a part each."""
    long = [[item for item in items if item.path.name == name] for name in LONGEST]
    others = [item for item in items if item.path.name not in LONGEST]
    ends = [round(number * len(items) / len(LONGEST)) for number in range(len(LONGEST) + 1)]
    ordered = []
    for first, end in zip(long, ends[1:], strict=True):
        room = max(0, end - len(ordered) - len(first))
        ordered += [*first, *others[:room]]
        others = others[room:]
    items[:] = ordered + others


@pytest.fixture(scope="session")
def robots():
    """All shipped robots by name."""
    from swarmtwin.robot import Robot

    return {path.stem: Robot.load(path) for path in sorted((REPOSITORY / "conf" / "robot").glob("*.yaml"))}


@pytest.fixture(scope="session")
def empty_store(tmp_path_factory):
    """A database as swarmtwin makes it for MLflow, with nothing in it yet."""
    from swarmtwin.tracking import store

    database = tmp_path_factory.mktemp("store") / "mlflow.db"
    store._make_database(database)
    return database


@pytest.fixture
def bare_workplace(tmp_path, monkeypatch):
    """An empty current folder with an MLflow store of its own."""
    monkeypatch.chdir(tmp_path)
    monkeypatch.delenv("MLFLOW_TRACKING_URI", raising=False)
    monkeypatch.delenv("SWARMTWIN_PARENT_RUN", raising=False)
    return tmp_path


@pytest.fixture
def workplace(bare_workplace, monkeypatch, empty_store):
    """The same, but the store's tables are copied when they are needed: making them takes more than a second."""
    from swarmtwin.files import whole_file

    def copy(database):
        with whole_file(database) as aside:
            shutil.copyfile(empty_store, aside)

    monkeypatch.setattr("swarmtwin.tracking.store._make_database", copy)
    return bare_workplace


@pytest.fixture(scope="session")
def browser(tmp_path_factory):
    """A headless Chromium; tests that look at pages are skipped where there is none."""
    from browser import CHROMIUM, Browser

    if CHROMIUM is None:
        pytest.skip("no Chromium here to look at the page with (apt install chromium)")
    with Browser(tmp_path_factory.mktemp("browser")) as browser:
        yield browser
