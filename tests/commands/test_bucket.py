"""Files in a bucket, as Amazon's S3 and what is like it offer: MLflow's models behind a server, and DVC's data."""

import os
import shutil
import subprocess
import sys

import pytest

from lab_server import check_a_model_goes_round, free_port, lab_server, wait_for

pytestmark = pytest.mark.services

KEYS = {"AWS_ACCESS_KEY_ID": "lab", "AWS_SECRET_ACCESS_KEY": "secret", "AWS_DEFAULT_REGION": "us-east-1"}


@pytest.fixture(scope="module")
def bucket_server(tmp_path_factory):
    """A server that answers as Amazon's does, in a process of its own, with a bucket `lab`; its address."""
    pytest.importorskip("moto", reason="pip install 'swarmtwin[services]'")
    said = tmp_path_factory.mktemp("bucket") / "server.log"
    port = free_port()
    with said.open("w") as log:
        process = subprocess.Popen([sys.executable, "-m", "moto.server", "-p", str(port)], stdout=log, stderr=log)
    try:
        address = f"http://127.0.0.1:{port}"
        wait_for(f"{address}/moto-api/", process, said)
        client(address).create_bucket(Bucket="lab")
        yield address
    finally:
        process.terminate()
        process.wait(timeout=30)


def client(address):
    import boto3

    keys = {"aws_access_key_id": KEYS["AWS_ACCESS_KEY_ID"], "aws_secret_access_key": KEYS["AWS_SECRET_ACCESS_KEY"]}
    return boto3.client("s3", endpoint_url=address, region_name=KEYS["AWS_DEFAULT_REGION"], **keys)


def stored(address, folder):
    """The names of all files in a folder of the bucket."""
    return [one["Key"] for one in client(address).list_objects_v2(Bucket="lab", Prefix=f"{folder}/")["Contents"]]


def test_a_model_trained_here_is_loaded_elsewhere_from_a_bucket(
    swarmtwin, workshop, tmp_path, monkeypatch, bucket_server
):
    """The keys are the server's alone: who trains and who measures needs none."""
    keys = {**KEYS, "MLFLOW_S3_ENDPOINT_URL": bucket_server}
    with lab_server(tmp_path, f"sqlite:///{tmp_path}/lab.db", "s3://lab/mlflow", **keys) as address:
        check_a_model_goes_round(swarmtwin, workshop, monkeypatch, address)
    assert any(name.endswith("weights.safetensors") for name in stored(bucket_server, "mlflow"))


def test_recordings_go_to_a_bucket_and_come_back(workshop, bucket_server):
    def dvc(*arguments):
        answer = subprocess.run(
            [sys.executable, "-m", "dvc", *arguments], env=os.environ | KEYS, capture_output=True, text=True
        )
        assert answer.returncode == 0, answer.stderr

    def held():
        folder = workshop / "reference"
        return {file.relative_to(folder): file.read_bytes() for file in folder.rglob("*") if file.is_file()}

    before = held()
    dvc("init", "--no-scm", "--quiet")
    dvc("add", "reference")
    dvc("remote", "add", "-d", "store", "s3://lab/data")
    dvc("remote", "modify", "store", "endpointurl", bucket_server)
    dvc("push")
    assert stored(bucket_server, "data")
    shutil.rmtree(workshop / "reference")
    shutil.rmtree(workshop / ".dvc" / "cache")
    dvc("pull")
    assert held() == before
