import errno
import subprocess
import sys

import mlflow
import pytest
import yaml
from mlflow.exceptions import MlflowException

from swarmtwin.errors import UserError
from swarmtwin.tracking.runs import dvc_hash, parent_run, tracked_run

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
        subprocess.run([sys.executable, "-c", script], check=True)
    with tracked_run("dynamics", "afterwards", CONFIG):
        pass
    runs = mlflow.search_runs(experiment_names=["dynamics"], output_format="list")
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


def test_inputs_are_known_by_their_dvc_hash(workplace):
    (workplace / ".dvc").mkdir()
    (workplace / "data" / "mgr").mkdir(parents=True)
    (workplace / "data.dvc").write_text("outs: [{md5: abc.dir, path: data}]\n")
    (workplace / "dvc.lock").write_text("stages: {t: {outs: [{md5: def.dir, path: artifacts/transitions/mgr}]}}\n")
    assert dvc_hash(workplace / "data" / "mgr") == "abc.dir"
    assert dvc_hash(workplace / "artifacts" / "transitions" / "mgr") == "def.dir"
    assert dvc_hash(workplace / "elsewhere") is None
    with tracked_run("dynamics", "x", {}, inputs=[workplace / "data"]) as run:
        pass
    assert mlflow.get_run(run.run_id).data.tags[f"dvc.{workplace / 'data'}"] == "abc.dir"
