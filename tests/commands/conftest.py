"""Small recordings of stand-ins, and models trained on them, made once for all tests of the commands that need some."""

import shutil
from pathlib import Path
from typing import NamedTuple

import pytest

from preloaded import preloaded_program
from swarmtwin.commands.app import run_command
from swarmtwin.standin.physics import Physics
from swarmtwin.tracking import registry

REPOSITORY = Path(__file__).resolve().parents[2]
RECORDINGS = {
    "reference": ("vehicle=1", "runs=30", "steps=30", "seed=1"),
    "other_vehicle": ("vehicle=2", "runs=10", "steps=30", "seed=2"),
    "open_loop": ("vehicle=1", "runs=3", "steps=30", "seed=3"),
    "pair": ("vehicle=[1,2]", "runs=6", "steps=20", "seed=4"),
}
TRAINING = ("recipe.batch_size=128", "seeds=1", "register=false", "pictures=false", "trainer.logger=none")
MODELS = {
    "mlp": ("model=mlp", "model.steps=150"),
    "kinematic": ("model=kinematic", "model.steps=150"),
    "rough": ("model=mlp", "model.steps=12"),
    "knowing": ("model=mlp", "model.steps=12", "model.situation=[command,previous_command]"),
}


class Answer(NamedTuple):
    """What a command answered: exit status, what it showed, and its error lines."""

    status: int
    shown: str
    error: str


def run(*arguments):
    """Run a command in this process; return its exit status."""
    return run_command(arguments[0], [str(argument) for argument in arguments[1:]])


@pytest.fixture(scope="session")
def library(made_once, empty_store):
    """A folder to read from: recordings by name, of `reference` prepared transitions and models, and a store of MLflow.

    The store holds no run.
    """

    def make(folder):
        with pytest.MonkeyPatch.context() as patch:
            patch.chdir(folder)
            patch.delenv("MLFLOW_TRACKING_URI", raising=False)
            patch.setattr(Physics, "bank_rows", 4096)
            shutil.copy(empty_store, "mlflow.db")
            shutil.copy(empty_store, "empty.db")
            for name, options in RECORDINGS.items():
                assert run("record", *options, f"output={name}") == 0
            assert run("prepare", "recording=reference", "pictures=false", "output=prepared") == 0
            for name, options in MODELS.items():
                assert run("train", "recording=reference", *TRAINING, *options, f"output=models/{name}") == 0

    return made_once("library", make)


@pytest.fixture
def workshop(workplace, library, monkeypatch):
    """A current folder with an MLflow store and copies of the recordings, where tables are not wrapped."""
    monkeypatch.setenv("COLUMNS", "250")
    shutil.copy(library / "empty.db", workplace / "mlflow.db")
    for name in RECORDINGS:
        shutil.copytree(library / name, workplace / name)
    return workplace


@pytest.fixture
def swarmtwin(workshop, capsys):
    """Run a command in this process, in the workshop; return its answer."""

    def call(*arguments):
        capsys.readouterr()
        status = run(*arguments)
        return Answer(status, *capsys.readouterr())

    return call


@pytest.fixture
def undrawn(monkeypatch):
    """Leave out what `evaluate` draws, which test_pictures.py looks at."""
    monkeypatch.setattr("swarmtwin.commands.evaluate.draw_evaluation", lambda made, output: None)


@pytest.fixture
def prepared(library, workshop) -> Path:
    """Copy the transitions prepared from `reference` into the workshop; their folder."""
    return shutil.copytree(library / "prepared", workshop / "prepared")


@pytest.fixture(scope="session")
def program(tmp_path_factory):
    """A `swarmtwin` to start as a process of its own, which has its packages at once."""
    file = tmp_path_factory.mktemp("program") / "swarmtwin"
    with preloaded_program(file, REPOSITORY / "src"):
        yield file


@pytest.fixture
def crown(workshop):
    """Register a model and make it champion, past the gate; return its version."""

    def call(folder, name="mgr-dynamics", **tags):
        version = registry.register(name, folder, folder.as_uri(), None, tags)
        registry.promote(version, "planted", registry.holder(name, "champion", version.task))
        return version

    return call


@pytest.fixture
def model(library, workshop):
    """Copy a trained model into the workshop, under its own name or another; return its folder."""

    def copy(name, to=None) -> Path:
        return shutil.copytree(library / "models" / name, workshop / (to or name))

    return copy
