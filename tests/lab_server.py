"""MLflow's server as containers/compose.yaml starts it, for a database and a place of files of a test's own."""

import contextlib
import os
import shutil
import signal
import socket
import subprocess
import sys
import time
from pathlib import Path

import pytest
import requests
import yaml

COMPOSE = Path(__file__).resolve().parents[1] / "containers" / "compose.yaml"
QUICK_TRAINING = (
    "recording=reference",
    "model=mlp",
    "model.steps=60",
    "recipe.batch_size=256",
    "seeds=1",
    "pictures=false",
)


def free_port():
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        return probe.getsockname()[1]


def served(database, artifacts, port):
    """The command by which the compose file starts the server, for a database's address and a place of files."""
    service = yaml.safe_load(COMPOSE.read_text())["services"]["server"]
    told = {
        "postgresql://swarmtwin:${PASSWORD}@${DATABASE_HOST:-database}/mlflow": database,
        "${ARTIFACTS:-/artifacts}": str(artifacts),
        "--host=0.0.0.0": "--host=127.0.0.1",
        "${PORT:-5000}": str(port),
        "${ALLOWED_HOSTS:-localhost:*,127.0.0.1:*,192.168.*,10.*}": "localhost:*,127.0.0.1:*",
    }
    words = [*service["entrypoint"], *service["command"]]
    for name, value in told.items():
        assert any(name in word for word in words), name
        words = [word.replace(name, value) for word in words]
    return [sys.executable, "-m", *words]


@contextlib.contextmanager
def lab_server(folder, database, artifacts, **environment):
    """Serve runs and models as long as the block lasts; what the server says lies in the folder. Gives its address."""
    port, said = free_port(), folder / "server.log"
    with said.open("w") as log:
        command = served(database, artifacts, port)
        process = subprocess.Popen(
            command, stdout=log, stderr=log, start_new_session=True, env=os.environ | environment
        )
    try:
        address = f"http://127.0.0.1:{port}"
        wait_for(f"{address}/health", process, said)
        yield address
    finally:
        with contextlib.suppress(ProcessLookupError):
            os.killpg(process.pid, signal.SIGTERM)
        process.wait(timeout=30)


def wait_for(address, process, said, longest_s=120):
    """Wait until a server answers, as long as its process lives."""
    began_s = time.monotonic()
    while time.monotonic() - began_s < longest_s and process.poll() is None:
        with contextlib.suppress(requests.RequestException):
            if requests.get(address, timeout=1).ok:
                return
        time.sleep(0.5)
    pytest.fail(f"no answer from {address}:\n{said.read_text()[-3000:]}")


def check_a_model_goes_round(swarmtwin, workshop, monkeypatch, address):
    """Train here, and measure elsewhere what the server hands out: no folder is shared."""
    monkeypatch.setenv("MLFLOW_TRACKING_URI", address)
    trained = swarmtwin("train", *QUICK_TRAINING, "output=model")
    assert trained.status == 0, trained.error
    shutil.rmtree(workshop / "model")
    model = "simulation=models:/mgr-dynamics@challenger"
    measured = swarmtwin("evaluate", model, "recording=other_vehicle", "output=evaluation")
    assert measured.status == 0, measured.error
    assert (workshop / "evaluation" / "metrics.json").is_file()
    assert not (workshop / "mlruns").exists()
