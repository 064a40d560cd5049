"""What a user installs, the wheel, does outside of the checkout what it does inside, on a robot's computer too."""

import os
import socket
import subprocess
import sys
import time
import urllib.request
from pathlib import Path

import pytest

REPOSITORY = Path(__file__).resolve().parents[1]

pytestmark = pytest.mark.claims  # some hundred megabytes are installed


@pytest.fixture(scope="module")
def wheel(tmp_path_factory):
    folder = tmp_path_factory.mktemp("wheel")
    pip("wheel", "--no-deps", "--wheel-dir", folder, REPOSITORY)
    (file,) = folder.glob("*.whl")
    return file


def pip(*arguments, python=sys.executable):
    """Call pip, and skip where it reaches no packages."""
    call = [python, "-m", "pip", "--disable-pip-version-check", *map(str, arguments), "--quiet"]
    answer = subprocess.run(call, capture_output=True, text=True)
    if answer.returncode and ("connection" in answer.stderr.lower() or "No matching distribution" in answer.stderr):
        pytest.skip(f"no packages can be fetched here: {answer.stderr.splitlines()[-1]}")
    assert answer.returncode == 0, answer.stderr


@pytest.fixture(scope="module")
def robots_computer(wheel, tmp_path_factory):
    """A fresh environment with the extra `deploy` alone; what is in it, and the folder to work in."""
    folder = tmp_path_factory.mktemp("robots-computer")
    subprocess.run([sys.executable, "-m", "venv", folder / "environment"], check=True)
    python = folder / "environment" / "bin" / "python"
    pip("install", "--no-compile", "-c", REPOSITORY / "constraints.txt", f"{wheel}[deploy]", python=python)
    return folder


@pytest.fixture
def swarmtwin(robots_computer):
    """Start the installed command outside of the checkout, or run it to its end."""
    own = ("PYTHONPATH", "SWARMTWIN_PRELOADED", "SWARMTWIN_PLUGINS", "VIRTUAL_ENV")
    environment = {name: value for name, value in os.environ.items() if name not in own}
    script = robots_computer / "environment" / "bin" / "swarmtwin"

    def start(*arguments):
        pipes = {"stdout": subprocess.PIPE, "stderr": subprocess.PIPE, "stdin": subprocess.DEVNULL, "text": True}
        return subprocess.Popen([script, *arguments], cwd=robots_computer, env=environment, **pipes)

    def run(*arguments):
        process = start(*arguments)
        shown, error = process.communicate(timeout=240)
        return process.returncode, shown, error

    run.start = start
    return run


def free_port():
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        return probe.getsockname()[1]


def test_the_extra_deploy_brings_nothing_that_trains(robots_computer):
    packages = robots_computer.glob("environment/lib/python*/site-packages/*")
    names = {file.name.partition("-")[0].lower() for file in packages}
    assert {"swarmtwin", "torch", "cv2"} <= names
    assert not names & {"lightning", "mlflow", "dvc", "optuna", "stable_baselines3", "sklearn", "numba", "onnx", "lab"}


def test_help_and_doctor_answer(swarmtwin):
    status, shown, _ = swarmtwin("--help")
    assert status == 0
    assert "deploy" in shown
    status, shown, error = swarmtwin("doctor")
    assert status == 0, error
    assert "✓ [deploy]" in shown
    assert "pip install 'swarmtwin[train]'" in shown
    status, shown, error = swarmtwin("doctor", "needs=[train]")
    assert status == 2
    assert "swarmtwin doctor: lacking: [train]" in error


def test_what_records_works_and_what_trains_says_which_extra_is_missing(swarmtwin):
    status, _, error = swarmtwin("record", "runs=10", "steps=20", "output=one")
    assert status == 0, error
    assert swarmtwin("prepare", "recording=one", "output=prepared")[0] == 0
    status, _, error = swarmtwin("train", "transitions=prepared", "output=model")
    assert status == 2
    assert len(error.splitlines()) == 1
    assert "pip install 'swarmtwin[train]'" in error


def test_a_registered_model_wants_mlflow_and_says_so(swarmtwin):
    status, _, error = swarmtwin("deploy", "policy=models:/mgr-policy@champion", "output=one")
    assert status == 2
    assert "pip install 'swarmtwin[tracking]'" in error


def test_a_policy_drives_emulated_robots_without_anything_that_trains(swarmtwin, robots_computer):
    """The whole path: broker, five robots, camera, page, controller; the recording and figures are left."""
    (bundled,) = robots_computer.glob("environment/lib/python*/site-packages/swarmtwin/deploy/bundled")
    broker, camera = free_port(), free_port()
    fleet = swarmtwin.start(
        "fleet", "vehicles=5", f"broker=embedded://127.0.0.1:{broker}", f"camera_port={camera}", "duration_s=200"
    )
    try:
        wait_for(f"http://127.0.0.1:{camera}/", fleet)
        status, _, error = swarmtwin(
            "deploy",
            f"policy={bundled / 'policy'}",
            f"simulation={bundled / 'simulation'}",
            f"broker=mqtt://127.0.0.1:{broker}",
            f"camera=http://127.0.0.1:{camera}/camera",
            "steps=20",
            "page.port=0",
            "output=first-drive",
        )
    finally:
        fleet.terminate()
        fleet.communicate(timeout=30)
    assert status == 0, error
    assert "not tracked: MLflow needs what is not installed here, mlflow, sqlalchemy" in error
    drive = robots_computer / "first-drive"
    assert {"recording.yaml", "metrics.json", "rollouts.npz"} <= {file.name for file in drive.iterdir()}
    assert len((drive / "runs" / "run_001.csv").read_text().splitlines()) > 5 * 20


def wait_for(address, process, longest_s=60):
    """Wait until somebody answers at an address, as long as the process lives."""
    began_s = time.monotonic()
    while time.monotonic() - began_s < longest_s and process.poll() is None:
        try:
            with urllib.request.urlopen(address, timeout=1):
                return
        except OSError:
            time.sleep(0.3)
    pytest.fail(f"nobody answers at {address}: {process.stderr.read() if process.poll() is not None else ''}")
