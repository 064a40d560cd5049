"""What a clone pulls for the documentation and its tests, by the locks of DVC, lies in the store beside the code."""

import json
import subprocess
from pathlib import Path

import pytest
import yaml

REPOSITORY = Path(__file__).resolve().parents[2]


def git(*arguments):
    command = ["git", "-C", str(REPOSITORY), *arguments]
    return subprocess.run(command, capture_output=True, text=True, check=True).stdout


def committed(file):
    """What the last commit says: whoever runs the pipeline has tables of their own, and need not push them."""
    return yaml.safe_load(git("show", f"HEAD:{file}"))


def pulled():
    """Each output that `make test` and `make docs` pull, and its hash."""
    for entry in committed("data.dvc")["outs"]:
        yield entry["path"], entry["md5"]
    for lock in git("ls-files", "dvc.lock", "docs/results/*dvc.lock").split():
        for name, stage in committed(lock)["stages"].items():
            if lock != "dvc.lock" or name.startswith("tables@"):
                yield from ((entry["path"], entry["md5"]) for entry in stage["outs"])


def test_what_a_clone_pulls_lies_in_the_store():
    if not (REPOSITORY / ".git").exists():
        pytest.skip("no repository, and so no store")
    stored = {"".join(file.split("/")[-2:]) for file in git("ls-files", ".dvcstore/files/md5").split()}
    missing = []
    for output, digest in pulled():
        wanted = {digest}
        if digest.endswith(".dir") and digest in stored:
            folder = REPOSITORY / ".dvcstore" / "files" / "md5" / digest[:2] / digest[2:]
            wanted |= {entry["md5"] for entry in json.loads(folder.read_text())}
        if wanted - stored:
            missing.append(output)
    assert not missing, f"dvc push {' '.join(missing)}, and git add .dvcstore"
