import os
from pathlib import Path

import pytest

os.environ.setdefault("OMP_NUM_THREADS", "1")
os.environ["MLFLOW_DISABLE_TELEMETRY"] = "true"

REPOSITORY = Path(__file__).resolve().parents[1]


@pytest.fixture(scope="session")
def robots():
    """All shipped robots by name."""
    from swarmtwin.robot import Robot

    return {path.stem: Robot.load(path) for path in sorted((REPOSITORY / "conf" / "robot").glob("*.yaml"))}


@pytest.fixture
def workplace(tmp_path, monkeypatch):
    """An empty current folder with an MLflow store of its own."""
    monkeypatch.chdir(tmp_path)
    monkeypatch.delenv("MLFLOW_TRACKING_URI", raising=False)
    monkeypatch.delenv("SWARMTWIN_PARENT_RUN", raising=False)
    return tmp_path
