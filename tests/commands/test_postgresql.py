"""One database for a lab: Optuna's studies and MLflow's runs in PostgreSQL, as Debian packages it."""

import os
import shutil
import subprocess
import tempfile
from pathlib import Path

import optuna
import pytest
from optuna.trial import TrialState

from lab_server import check_a_model_goes_round, free_port, lab_server

BINARIES = sorted(Path("/usr/lib/postgresql").glob("*/bin/initdb"))[-1:] or [Path(shutil.which("initdb") or "none")]

pytestmark = pytest.mark.skipif(
    not BINARIES[0].exists(), reason="there is no PostgreSQL server: apt install postgresql"
)


def as_its_user(folder, program, *arguments):
    """Run one of the server's programs; it refuses root, so root runs it as Debian's user of it."""
    who = ["runuser", "-u", "postgres", "--"] if os.getuid() == 0 else []
    call = [*who, BINARIES[0].with_name(program), *map(str, arguments)]
    answer = subprocess.run(call, cwd=folder, stdout=subprocess.DEVNULL, stderr=subprocess.PIPE, text=True)
    assert answer.returncode == 0, answer.stderr


@pytest.fixture(scope="module")
def server():
    """A server of its own with the databases `studies` and `mlflow`; where it is, as host:port."""
    pytest.importorskip("psycopg", reason="pip install 'swarmtwin[postgresql]'")
    folder = Path(tempfile.mkdtemp(prefix="postgresql-"))
    if os.getuid() == 0:
        shutil.chown(folder, "postgres")
    port = free_port()
    as_its_user(folder, "initdb", "-D", folder / "data", "-U", "swarmtwin", "-A", "trust", "-E", "UTF8", "--no-sync")
    options = f"-p {port} -k {folder} -c listen_addresses=127.0.0.1 -c fsync=off"
    as_its_user(folder, "pg_ctl", "-D", folder / "data", "-o", options, "-l", folder / "log", "-w", "start")
    try:
        for database in ("studies", "mlflow"):
            as_its_user(folder, "createdb", "-h", "127.0.0.1", "-p", port, "-U", "swarmtwin", database)
        yield f"127.0.0.1:{port}"
    finally:
        as_its_user(folder, "pg_ctl", "-D", folder / "data", "-m", "immediate", "-w", "stop")
        shutil.rmtree(folder, ignore_errors=True)


@pytest.mark.end_to_end
def test_two_processes_share_a_study_in_postgresql_and_a_later_call_goes_on(swarmtwin, server):
    storage = f"postgresql://swarmtwin@{server}/studies"
    search = ("tune", "recording=reference", "model=kinematic", "recipe.epochs=3", "recipe.batch_size=256", "study=one")
    answer = swarmtwin(*search, f"storage={storage}", "workers=2", "trials=4")
    assert answer.status == 0, answer.error
    first = optuna.load_study(study_name="one", storage=storage).get_trials(states=[TrialState.COMPLETE])
    assert sorted(trial.number for trial in first) == [0, 1, 2, 3]
    assert swarmtwin(*search, f"storage={storage}", "workers=1", "trials=5").status == 0
    trials = optuna.load_study(study_name="one", storage=storage).get_trials(states=[TrialState.COMPLETE])
    assert [trial.params for trial in trials[:4]] == [trial.params for trial in first]
    assert len(trials) == 5


def test_a_database_that_is_not_there_is_one_line(swarmtwin):
    storage = f"postgresql://swarmtwin:secret@127.0.0.1:{free_port()}/studies"
    answer = swarmtwin("tune", "recording=reference", "model=kinematic", "study=one", f"storage={storage}")
    assert answer.status == 2
    assert "cannot be opened" in answer.error
    assert "secret" not in answer.error


@pytest.mark.claims
def test_a_model_trained_here_is_loaded_elsewhere_by_the_server_of_the_compose_file(
    swarmtwin, server, workshop, tmp_path, monkeypatch
):
    """Runs and the registry lie in PostgreSQL, files come through the server: no folder is shared."""
    artifacts = tmp_path / "artifacts"
    with lab_server(tmp_path, f"postgresql://swarmtwin@{server}/mlflow", artifacts) as address:
        check_a_model_goes_round(swarmtwin, workshop, monkeypatch, address)
    assert list(artifacts.rglob("weights.safetensors"))
