"""Every input of a run has a digest of its own, and DVC's hash of exactly that folder."""

import hashlib
import json

import mlflow
import pytest
from mlflow.data import get_source
from mlflow.exceptions import MlflowException

from swarmtwin.errors import UserError
from swarmtwin.tracking.datasets import Dataset, dvc_hashes, files_digest
from swarmtwin.tracking.runs import tracked_run


@pytest.fixture
def repository(workplace):
    """Data of two robots in one output of DVC's, whose list of files is at hand, and an output of a stage."""
    (workplace / ".dvc").mkdir()
    for robot in ("mgr", "mur"):
        for name in ("reference", "open_loop"):
            folder = workplace / "data" / robot / name
            folder.mkdir(parents=True)
            (folder / "run.csv").write_text(f"{robot} {name}")
    files = sorted((workplace / "data").rglob("*.csv"))
    text = dvc_list({file.relative_to(workplace / "data").as_posix(): md5(file.read_text()) for file in files})
    listing = workplace / ".dvc" / "cache" / "files" / "md5" / md5(text)[:2] / f"{md5(text)[2:]}.dir"
    listing.parent.mkdir(parents=True)
    listing.write_text(text)
    (workplace / "data.dvc").write_text(f"outs: [{{md5: {md5(text)}.dir, path: data}}]\n")
    (workplace / "dvc.lock").write_text("stages: {t: {outs: [{md5: def.dir, path: artifacts/transitions/mgr}]}}\n")
    return workplace


def md5(text):
    return hashlib.md5(text.encode()).hexdigest()


def dvc_list(hashes):
    """The content of DVC's file that lists an output's files."""
    return json.dumps([{"md5": hashes[file], "relpath": file} for file in sorted(hashes)])


def test_an_input_has_the_hash_that_dvc_gives_this_very_folder(repository):
    data, unknown = repository / "data", repository / "elsewhere"
    made = repository / "artifacts" / "transitions" / "mgr"
    recordings = [data / "mgr" / "reference", data / "mur" / "reference", data / "mgr" / "open_loop"]
    hashes = dvc_hashes([data, *recordings, made, unknown, recordings[0] / "run.csv"])
    assert hashes[made] == "def.dir"
    assert hashes[recordings[0]] == f"{md5(dvc_list({'run.csv': md5('mgr reference')}))}.dir"
    assert hashes[recordings[0] / "run.csv"] == md5("mgr reference")
    assert len({hashes[folder] for folder in (data, *recordings)}) == 4
    assert unknown not in hashes


def test_where_the_list_of_files_is_not_at_hand_no_hash_is_given_but_that_of_the_whole(repository):
    (repository / "data.dvc").write_text("outs: [{md5: abc.dir, path: data}]\n")
    assert dvc_hashes([repository / "data" / "mgr" / "reference"]) == {}
    assert dvc_hashes([repository / "data"]) == {repository / "data": "abc.dir"}


def test_inputs_are_datasets_of_their_run(repository):
    reference, measured = repository / "data" / "mgr" / "reference", repository / "data" / "mgr" / "open_loop"
    inputs = [
        Dataset(reference, "reference", "a" * 64, {"rows": 30, "runs": 3}, ("x_mm", "heading_rad")),
        Dataset.of_files(measured, "measured"),
    ]
    with tracked_run("diagnosis", "x", {}, inputs) as run:
        pass
    kept = mlflow.get_run(run.run_id)
    tags = [{tag.key: tag.value for tag in each.tags} for each in kept.inputs.dataset_inputs]
    datasets = [each.dataset for each in kept.inputs.dataset_inputs]
    given = {own["mlflow.data.context"]: dataset for own, dataset in zip(tags, datasets, strict=True)}
    assert {name: each.name for name, each in given.items()} == {"reference": "reference", "measured": "open_loop"}
    assert json.loads(given["reference"].profile) == {"rows": 30, "runs": 3}
    assert [column["name"] for column in json.loads(given["reference"].schema)["mlflow_colspec"]] == [
        "x_mm",
        "heading_rad",
    ]
    assert given["reference"].digest == "a" * 36
    assert given["measured"].digest == files_digest(measured)
    assert get_source(given["measured"]).uri == str(measured)
    hashes = dvc_hashes([reference, measured])
    assert {kept.data.tags[f"dvc.{folder}"] for folder in (reference, measured)} == set(hashes.values())
    assert {own["dvc"] for own in tags} == set(hashes.values())


def test_two_runs_may_add_the_same_input_at_the_same_moment(repository, monkeypatch):
    """Between MLflow's look whether it is there and its insertion, another run inserts it."""
    given = Dataset(repository / "data" / "mgr" / "reference", "reference", "b" * 16)
    log_inputs, tried = mlflow.MlflowClient.log_inputs, []

    def overtaken(client, run_id, inputs):
        tried.append(run_id)
        if len(tried) == 1:
            other = client.create_run(client.get_run(run_id).info.experiment_id).info.run_id
            log_inputs(client, other, inputs)
            raise MlflowException("(sqlite3.IntegrityError) UNIQUE constraint failed: datasets.name, datasets.digest")
        log_inputs(client, run_id, inputs)

    monkeypatch.setattr(mlflow.MlflowClient, "log_inputs", overtaken)
    with tracked_run("diagnosis", "x", {}, [given]) as run:
        pass
    assert [each.dataset.name for each in mlflow.get_run(run.run_id).inputs.dataset_inputs] == ["reference"]
    assert len(tried) == 2


def test_any_other_fault_of_the_store_is_told_at_once(repository, monkeypatch):
    tried = []

    def refused(client, run_id, inputs):
        tried.append(run_id)
        raise MlflowException("the table is gone")

    monkeypatch.setattr(mlflow.MlflowClient, "log_inputs", refused)
    given = Dataset(repository / "data" / "mgr" / "reference", "reference", "b" * 16)
    with pytest.raises(UserError, match="the table is gone"), tracked_run("diagnosis", "x", {}, [given]):
        pass
    assert len(tried) == 1


def test_a_digest_covers_names_and_content_of_all_files(tmp_path):
    (tmp_path / "inside").mkdir()
    (tmp_path / "inside" / "one").write_text("1")
    first = files_digest(tmp_path)
    (tmp_path / "note").write_text("")
    assert files_digest(tmp_path) != first == files_digest(tmp_path, leave_out=["note"])
    (tmp_path / "inside" / "one").rename(tmp_path / "inside" / "two")
    assert files_digest(tmp_path, leave_out=["note"]) != first


@pytest.mark.parametrize(
    "content", [b"- a list", b"stages: null", b"stages: {x: {outs: [{md5: abc}]}}", b"\xff\xfe", b"a: [b"]
)
def test_a_lock_that_dvc_did_not_write_is_told_and_gives_no_hash(tmp_path, caplog, content):
    (tmp_path / ".dvc").mkdir()
    (tmp_path / "dvc.lock").write_bytes(content)
    assert dvc_hashes([tmp_path / "data"]) == {}
    assert "dvc.lock is not as DVC writes it" in caplog.text
