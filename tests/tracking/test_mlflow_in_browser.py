"""MLflow's own interface, as `make ui` opens it: runs, registered models and a champion's page, without errors."""

import os
import signal
import socket
import subprocess
import sys
import time
import urllib.error
import urllib.request
from contextlib import contextmanager

import mlflow
import pytest
from PIL import Image

from swarmtwin.tracking import registry
from swarmtwin.tracking.champion_page import Evidence, champion_page
from swarmtwin.tracking.runs import tracked_run
from tiny_policies import simulation

pytestmark = pytest.mark.claims  # the server takes longer to begin than all else
WHO_IS_IT = "/mlflow/users/current"  # asked of every server; one without a login has no users, and answers 404


@contextmanager
def interface(folder):
    """MLflow's server for the store in a folder; its address."""
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        port = free.getsockname()[1]
    address = f"http://127.0.0.1:{port}"
    command = [sys.executable, "-m", "mlflow", "ui", "--backend-store-uri", "sqlite:///mlflow.db", "--port", str(port)]
    with (folder / "server.log").open("w") as log:
        server = subprocess.Popen(
            [*command, "--host", "127.0.0.1", "--workers", "1"],
            cwd=folder,
            env={**os.environ, "MLFLOW_DISABLE_TELEMETRY": "true"},
            stdout=log,
            stderr=log,
            start_new_session=True,
        )
        try:
            end = time.monotonic() + 90
            while not answers(f"{address}/health"):
                assert time.monotonic() < end, (folder / "server.log").read_text()
                assert server.poll() is None, (folder / "server.log").read_text()
                time.sleep(0.3)
            yield address
        finally:
            os.killpg(server.pid, signal.SIGTERM)
            server.wait(20)


def answers(address):
    try:
        with urllib.request.urlopen(address, timeout=5) as answer:
            return answer.status == 200
    except (urllib.error.URLError, TimeoutError, ConnectionError):
        return False


def test_runs_and_registered_models_are_shown_without_errors(workplace, browser, robots):
    with tracked_run("dynamics", "mgr crnet", {"robot": {"name": "mgr"}, "seed": 3}, seed=3) as run:
        run.metrics({"validation_position_mm": 3.25})
        run.history([(epoch, {"train_position_mm": 5.0 - epoch}) for epoch in range(3)])
        folder = simulation(workplace / "model", robots["mgr"])
        Image.new("RGB", (37, 20), "red").save(folder / "history.png")
        kept = run.model(folder, "dynamics")
    version = registry.register("mgr-dynamics", folder, kept, run.run_id, {"model": "kinematic"})
    evidence = Evidence("its error is 12.0% smaller (95 % interval 9.0% to 15.0% smaller)", "10 runs", "the one before")
    registry.promote(version, "better", None, champion_page(version, evidence, "swarmtwin promote candidate=1"))
    experiment = mlflow.get_run(run.run_id).info.experiment_id
    pages = {
        f"#/experiments/{experiment}/runs": ["mgr crnet"],
        f"#/experiments/{experiment}/runs/{run.run_id}": ["validation_position_mm", "3.25", "robot.name"],
        "#/models/mgr-dynamics": ["mgr-dynamics", "champion"],
        "#/models/mgr-dynamics/versions/1": [
            "It became champion because its error is 12.0% smaller (95 % interval 9.0% to 15.0% smaller).",
            "Compared with the one before.",
            "Promoted by swarmtwin promote candidate=1",
        ],
    }
    with interface(workplace) as address:
        for path, said in pages.items():
            page = browser.open(f"{address}/{path}")
            for words in said:
                page.wait_until(f"document.body.innerText.includes({words!r})")
            assert [error for error in page.errors if WHO_IS_IT not in error] == [], path
            assert page.elsewhere() == [], path
        page.wait_until("[...document.images].some(picture => picture.naturalWidth === 37)")
        assert page.evaluate(f"[...document.links].some(link => link.hash.endsWith('/runs/{run.run_id}'))")
