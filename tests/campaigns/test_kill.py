"""The checks of the campaign in `kill.py`, which is one command: that they see what a death may leave."""

import shutil
import signal
import time

import mlflow
from forked import fork
from kill import Case, ended, failures, half_versions, kill, registered, still_running, table

from swarmtwin.files import folder_digest
from swarmtwin.tracking import registry
from swarmtwin.tracking.runs import tracked_run


def test_what_a_death_may_leave_in_a_store_is_seen(workplace):
    assert (registered(workplace), half_versions(workplace), still_running(workplace)) == ({}, [], [])
    model = workplace / "model"
    model.mkdir()
    (model / "model.yaml").write_text("a model")
    with tracked_run("dynamics", "mine", {}) as run:
        version = registry.register("mgr-dynamics", model, run.folder(model, "model"), run.run_id, {})
        registry.challenge(version, lambda challenger: (True, "newer"))
        assert still_running(workplace) == ["mine"]
    assert still_running(workplace) == []
    assert registered(workplace) == {"mgr-dynamics@challenger": folder_digest(model)}
    assert half_versions(workplace) == []
    (version.folder() / "model.yaml").write_text("half a")
    assert half_versions(workplace) == ["mgr-dynamics version 1"]
    shutil.rmtree(mlflow.get_run(run.run_id).info.artifact_uri.removeprefix("file://"))
    assert half_versions(workplace) == ["mgr-dynamics version 1"]
    assert registered(workplace) == {"mgr-dynamics@challenger": "nothing"}


def test_a_process_is_killed_and_its_end_is_told(tmp_path):
    (tmp_path / "project").mkdir()
    since = time.monotonic()
    process = fork(["prepare", "output=out"], tmp_path / "project", tmp_path)
    kill(process, "SIGKILL")
    assert ended(process, tmp_path, since).status == -signal.SIGKILL


def test_the_table_counts_how_the_cases_ended():
    about = {"start": "here", "moment_s": 1.0, "before": "runs", "died": "died"}
    cases = [
        Case(number=0, command="train", manner="SIGKILL", outcome="went on", **about),
        Case(number=1, command="train", manner="SIGINT", outcome="its output was whole", **about),
        Case(number=2, command="tune", manner="SIGTERM", outcome="still RUNNING: x", **about),
        Case(number=3, command="tune", manner="SIGTERM", outcome="went on", **{**about, "died": "finished before"}),
    ]
    assert [case.number for case in failures(cases)] == [2]
    assert table(cases).splitlines()[2:] == [
        "| train | 1 | 1 | 1 | 1 | 0 | 0 |",
        "| tune | 0 | 2 | 0 | 0 | 1 | 1 |",
        "| all | 1 | 3 | 1 | 1 | 1 | 1 |",
    ]
