import errno
import os
import shutil
import subprocess
import time

import mlflow
import pytest
import yaml
from mlflow.exceptions import MlflowException

from preloaded import run_forked
from swarmtwin.errors import UserError
from swarmtwin.tracking.runs import parent_run, tracked_run
from swarmtwin.tracking.store import use_store

CONFIG = {"robot": {"name": "mgr"}, "model": {"name": "mlp", "hidden": [128, 128]}, "seed": 3}


def test_a_run_keeps_its_configuration_seed_metrics_and_history(workplace):
    with tracked_run("dynamics", "mgr mlp", CONFIG, seed=3) as run:
        run.metrics({"position_mm": 3.5})
        run.history([(epoch, {"validation_position_mm": 5.0 - epoch}) for epoch in range(3)])
    kept = mlflow.get_run(run.run_id)
    assert kept.info.status == "FINISHED"
    assert kept.data.params["model.hidden"] == "[128, 128]"
    assert kept.data.tags["seed"] == "3"
    assert kept.data.metrics == {"position_mm": 3.5, "validation_position_mm": 3.0}
    assert yaml.safe_load(mlflow.artifacts.load_text(f"{kept.info.artifact_uri}/config.yaml")) == CONFIG
    history = mlflow.MlflowClient().get_metric_history(run.run_id, "validation_position_mm")
    assert [point.value for point in history] == [5, 4, 3]


@pytest.mark.parametrize(("project", "name"), [(None, "swarmtwin/dynamics"), ("my lab", "my lab/dynamics")])
def test_experiments_of_two_projects_on_one_server_are_apart(workplace, monkeypatch, project, name):
    """Found again by their project, also where database and files were copied together."""
    if project:
        with tracked_run("dynamics", "of another project", CONFIG):
            pass
        monkeypatch.setenv("SWARMTWIN_PROJECT", project)
    with parent_run("dynamics", "seed=1,2", "sweep") as parent, tracked_run("dynamics", "mgr mlp", CONFIG) as run:
        pass
    runs = mlflow.search_runs(experiment_names=[name], output_format="list")
    assert {found.info.run_id for found in runs} == {parent, run.run_id}
    copy = workplace.with_name(f"{workplace.name} copied")
    shutil.copytree(workplace, copy)
    shutil.rmtree(workplace / "mlruns")
    monkeypatch.chdir(copy)
    monkeypatch.delenv("MLFLOW_TRACKING_URI", raising=False)  # MLflow sets it
    use_store()
    assert yaml.safe_load(mlflow.artifacts.load_text(f"runs:/{run.run_id}/config.yaml")) == CONFIG
    assert (copy / "mlruns" / name / run.run_id).is_dir()


@pytest.mark.parametrize(("failure", "status"), [(ValueError, "FAILED"), (KeyboardInterrupt, "KILLED")])
def test_a_run_says_how_it_ended(workplace, failure, status):
    def fail():
        with tracked_run("dynamics", "mgr mlp", CONFIG) as run:
            runs.append(run.run_id)
            raise failure

    runs = []
    with pytest.raises(failure):
        fail()
    assert mlflow.get_run(runs[0]).info.status == status


def test_runs_of_a_sweep_have_one_parent_also_from_other_processes(workplace):
    script = "from swarmtwin.tracking.runs import tracked_run\nwith tracked_run('dynamics', 'child', {}): pass"
    with parent_run("dynamics", "model=crnet,lstm", "sweep") as parent:
        with tracked_run("dynamics", "here", CONFIG):
            pass
        assert run_forked(script) == 0
    with tracked_run("dynamics", "afterwards", CONFIG):
        pass
    runs = mlflow.search_runs(experiment_names=["swarmtwin/dynamics"], output_format="list")
    parents = {run.info.run_name: run.data.tags.get("mlflow.parentRunId") for run in runs}
    assert parents.pop("model=crnet,lstm") is None
    assert parents == {"here": parent, "child": parent, "afterwards": None}
    assert {run.info.status for run in runs} == {"FINISHED"}


def test_an_unusable_store_is_one_clear_error(workplace, monkeypatch):
    (workplace / "blocked").write_text("a file where a folder would be")
    monkeypatch.setenv("MLFLOW_TRACKING_URI", f"sqlite:///{workplace}/blocked/mlflow.db")
    with pytest.raises(UserError, match=r"the MLflow store sqlite:.* cannot be used"), tracked_run("dynamics", "x", {}):
        pass


def test_a_full_disk_is_not_blamed_on_the_store(workplace, monkeypatch):
    def fail(*arguments, **options):
        raise OSError(errno.ENOSPC, "No space left on device", "config.yaml")

    monkeypatch.setattr(mlflow, "log_text", fail)
    with pytest.raises(OSError, match="No space left on device"), tracked_run("dynamics", "x", {}):
        pass


def test_a_store_that_fails_while_a_run_goes_on_is_one_clear_error(workplace, monkeypatch):
    def fail(*arguments, **options):
        raise MlflowException("API request failed: Connection refused")

    with tracked_run("dynamics", "x", {}) as run:
        monkeypatch.setattr(mlflow.MlflowClient, "log_batch", fail)
        with pytest.raises(UserError, match=r"the MLflow store sqlite:.* cannot be used \(API request failed: Connec"):
            run.metrics({"position_mm": 1.0})


def test_the_pipelines_own_lock_is_no_uncommitted_change_of_the_code(workplace, monkeypatch):
    def git(*arguments):
        subprocess.run(["git", "-c", "user.name=x", "-c", "user.email=x@y", *arguments], check=True)

    def has_changes():
        with tracked_run("dynamics", "x", {}) as run:
            pass
        return mlflow.get_run(run.run_id).data.tags["git.uncommitted_changes"]

    files = [workplace / name for name in ("dvc.lock", "data.dvc", "code.py")]
    for file in files:
        file.write_text("one\n")
    (workplace / "inside").mkdir()
    git("init", "--quiet")
    git("add", "dvc.lock", "data.dvc", "code.py")
    git("commit", "--quiet", "--message", "all")
    for file in files[:2]:
        file.write_text("another\n")
    assert has_changes() == "false"
    files[2].write_text("another\n")
    assert has_changes() == "true"
    monkeypatch.setenv("MLFLOW_TRACKING_URI", f"sqlite:///{workplace}/mlflow.db")
    monkeypatch.chdir(workplace / "inside")
    assert has_changes() == "true"


def test_a_server_that_is_away_is_told_within_seconds(workplace, monkeypatch):
    monkeypatch.setenv("MLFLOW_TRACKING_URI", "http://127.0.0.1:9")
    started = time.monotonic()
    away = r"http://127.0.0.1:9 cannot be used .*: start its server"
    with pytest.raises(UserError, match=away), tracked_run("dynamics", "x", {}):
        pass
    assert time.monotonic() - started < 10


def test_a_database_that_cannot_be_written_is_told_at_once(workplace, monkeypatch):
    with tracked_run("dynamics", "x", {}):
        pass
    database = shutil.copy("mlflow.db", workplace / "other.db")  # that no connection of this process has open
    database.chmod(0o444)
    monkeypatch.setenv("MLFLOW_TRACKING_URI", "sqlite:///other.db")
    shield = ["chattr", "+i", database]  # from root
    if os.access(database, os.W_OK) and subprocess.run(shield, capture_output=True, check=False).returncode:
        pytest.skip("nothing keeps root from writing here")
    try:
        with pytest.raises(UserError, match=r"readonly database.*can be written"), tracked_run("dynamics", "y", {}):
            pass
    finally:
        subprocess.run(["chattr", "-i", database], capture_output=True, check=False)


def test_a_database_may_be_named_from_the_working_folder(workplace, monkeypatch):
    monkeypatch.setenv("MLFLOW_TRACKING_URI", "sqlite:///runs.db")
    with tracked_run("dynamics", "x", {}) as run:
        pass
    assert (workplace / "mlruns" / "swarmtwin" / "dynamics" / run.run_id / "artifacts" / "config.yaml").exists()


def test_runs_whose_process_was_killed_are_closed_by_the_next(workplace):
    """Of any output, and the run of a sweep or study that grouped them."""
    script = "import os; from swarmtwin.tracking.runs import parent_run, tracked_run\n"
    script += "with parent_run('dynamics', 'sweep', 'sweep'), tracked_run('dynamics', 'killed', {'output': 'out'}):"
    script += " os.kill(os.getpid(), 9)"
    assert run_forked(script) == -9

    def statuses():
        found = mlflow.search_runs(experiment_names=["swarmtwin/dynamics"], output_format="list")
        return {run.info.run_name: run.info.status for run in found}

    use_store()
    assert statuses() == {"killed": "RUNNING", "sweep": "RUNNING"}
    with tracked_run("dynamics", "other", {"output": "elsewhere"}):
        assert statuses() == {"killed": "KILLED", "sweep": "KILLED", "other": "RUNNING"}


def test_a_store_that_was_killed_while_it_was_made_is_made_anew(bare_workplace):
    """With half of MLflow's tables there, MLflow itself does not go on."""
    script = "import os, sys; from sqlalchemy import event, Engine\n"
    script += "made = []\n"
    script += "@event.listens_for(Engine, 'before_cursor_execute')\n"
    script += "def kill(connection, cursor, statement, *_):\n"
    script += "    made.append(statement)\n"
    script += "    if sum('CREATE TABLE' in one for one in made) == 20: os.kill(os.getpid(), 9)\n"
    script += "from swarmtwin.tracking.store import use_store\nuse_store()"
    assert run_forked(script) == -9
    with tracked_run("dynamics", "again", {}):
        pass
    assert sorted(path.name for path in bare_workplace.iterdir()) == [".mlflow.db.lock.partial", "mlflow.db", "mlruns"]


def test_a_failure_that_the_store_cannot_even_note_is_told_as_it_is(workplace, monkeypatch):
    def fail(*arguments, **options):
        raise MlflowException("disk is full")

    def with_a_full_disk():
        with tracked_run("dynamics", "x", {}):
            monkeypatch.setattr(mlflow.MlflowClient, "set_terminated", fail)
            raise OSError(errno.ENOSPC, "No space left on device")

    with pytest.raises(OSError, match="No space left"):
        with_a_full_disk()
