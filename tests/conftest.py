import fcntl
import gc
import os
import pickle
import shutil
import signal
import time
from pathlib import Path

import pytest

os.environ.setdefault("OMP_NUM_THREADS", "1")
os.environ["MLFLOW_DISABLE_TELEMETRY"] = "true"
gc.set_threshold(30000, 50, 100)  # a million objects that stay, of the packages, are looked through now and then

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


def pytest_runtest_setup(item):
    """Leave out claims that would begin too late: `.ci/run` may take an hour, on slow machines as well."""
    until = float(os.environ.get("SWARMTWIN_CLAIMS_UNTIL", "inf"))
    if item.get_closest_marker("claims") and time.time() > until:
        pytest.skip("the time that was given to the claims is over; `make claims` tests all of them")


@pytest.fixture(scope="session", autouse=True)
def unhurried_disks():
    """Let these processes and their databases not wait for the disk: no test survives a power cut anyway."""
    from sqlalchemy import Engine, event

    fsync, os.fsync = os.fsync, lambda file: None

    @event.listens_for(Engine, "connect")
    def hurry(connection, record):
        if "sqlite" in type(connection).__module__:
            connection.execute("PRAGMA synchronous = OFF")

    yield
    event.remove(Engine, "connect", hurry)
    os.fsync = fsync


@pytest.fixture(scope="session", autouse=True)
def parsed_once():
    """Let Hydra parse a file of configuration once as long as it stays what it is: a command reads some ten of them."""
    from omegaconf import OmegaConf

    parse, parsed = OmegaConf.load, {}

    def load(file):
        about = os.fstat(file.fileno())
        version = (file.name, about.st_ino, about.st_mtime_ns, about.st_size)
        if version not in parsed:
            parsed[version] = pickle.dumps(parse(file))
        return pickle.loads(parsed[version])

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(OmegaConf, "load", load)
        yield


@pytest.fixture(scope="session", autouse=True)
def coarse_pictures():
    """Let figures be saved with few pixels and drawn once instead of being laid out first, which takes most of it."""
    import numpy as np
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure
    from PIL import Image

    def draw(figure, file, **options):
        figure.set_layout_engine("none")
        figure.set_dpi(20)
        canvas = FigureCanvasAgg(figure)
        canvas.draw()
        Image.fromarray(np.asarray(canvas.buffer_rgba())).save(file, "png")

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(Figure, "savefig", draw)
        yield


@pytest.fixture(scope="session")
def made_once(tmp_path_factory):
    """Make a folder that all processes of a test run read from: `make` fills it in the first that asks for it."""

    def made(name, make):
        shared = tmp_path_factory.getbasetemp()
        shared = shared.parent if "PYTEST_XDIST_WORKER" in os.environ else shared
        folder, done = shared / name, shared / f"{name}.done"
        with (shared / f"{name}.lock").open("w") as lock:
            fcntl.flock(lock, fcntl.LOCK_EX)
            if not done.exists():
                shutil.rmtree(folder, ignore_errors=True)
                folder.mkdir()
                make(folder)
                done.touch()
        return folder

    return made


@pytest.fixture(scope="session")
def robots():
    """All shipped robots by name."""
    from swarmtwin.robot import Robot

    return {path.stem: Robot.load(path) for path in sorted((REPOSITORY / "conf" / "robot").glob("*.yaml"))}


@pytest.fixture(scope="session")
def empty_store(made_once):
    """A database as swarmtwin makes it for MLflow, with nothing in it yet."""
    from swarmtwin.tracking import store

    return made_once("store", lambda folder: store._make_database(folder / "mlflow.db")) / "mlflow.db"


@pytest.fixture
def bare_workplace(tmp_path, monkeypatch):
    """An empty current folder with an MLflow store of its own."""
    monkeypatch.chdir(tmp_path)
    monkeypatch.delenv("MLFLOW_TRACKING_URI", raising=False)
    monkeypatch.delenv("SWARMTWIN_PARENT_RUN", raising=False)
    monkeypatch.delenv("SWARMTWIN_PROJECT", raising=False)
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
