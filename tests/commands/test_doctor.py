"""What this machine lacks is told in a line each, with what to do; nothing is changed on the way."""

import socket

import pytest

from swarmtwin import extras
from swarmtwin.commands.app import run_command
from swarmtwin.errors import UserError

STATED = [
    "numpy>=2",
    'numpy>=999; extra == "deploy"',
    'no-such-package<3,>=1; extra == "deploy"',
    'swarmtwin[deploy]; extra == "train"',
    'pandas>=1; extra == "train"',
]


def test_an_extra_is_what_it_states_and_what_the_extras_in_it_state(monkeypatch):
    monkeypatch.setattr(extras, "requires", lambda name: STATED)
    assert {one.name for one in extras.requirements("base")} == {"numpy"}
    assert {one.name for one in extras.requirements("train")} == {"numpy", "no-such-package", "pandas"}
    missing = extras.missing_packages("train")
    assert missing["no-such-package"] is None
    assert missing["numpy"].startswith("2")  # another version than is asked for
    assert missing.keys() == {"numpy", "no-such-package"}
    assert not extras.missing_packages("base")
    with pytest.raises(UserError, match=r"it needs what is not installed here, no-such-package: .*swarmtwin\[train\]"):
        extras.require_extra("train", "it")


def test_what_a_part_lacks_is_told_and_a_part_that_is_needed_is_a_mistake(bare_workplace, monkeypatch, capsys):
    monkeypatch.setattr(extras, "requires", lambda name: STATED)
    assert run_command("doctor", ["needs=[deploy]"]) == 2
    shown, error = capsys.readouterr()
    assert "✗ [deploy]" in shown
    assert "no-such-package, numpy 2" in shown
    assert "pip install 'swarmtwin[deploy]'" in shown
    assert error == "swarmtwin doctor: lacking: [deploy]; the lines above say what to do\n"


@pytest.mark.parametrize(
    ("plant", "lacking", "remedy"),
    [
        (lambda folder, patch: remote(folder, "../gone"), "DVC remote", "there is no folder"),
        (lambda folder, patch: patch.setenv("MLFLOW_TRACKING_URI", dead_server()), "MLflow store", "start its server"),
    ],
    ids=["remote", "server"],
)
def test_what_cannot_be_reached_is_lacking(bare_workplace, monkeypatch, capsys, plant, lacking, remedy):
    plant(bare_workplace, monkeypatch)
    assert run_command("doctor", []) == 2
    shown, error = capsys.readouterr()
    (line,) = [line for line in shown.splitlines() if line.startswith(f"✗ {lacking}")]
    assert remedy in line
    assert f"lacking: {lacking};" in error


def remote(folder, url):
    (folder / ".dvc").mkdir()
    (folder / ".dvc" / "config").write_text(f"[core]\n    remote = lab\n['remote \"lab\"']\n    url = {url}\n")


def dead_server():
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        return f"http://127.0.0.1:{probe.getsockname()[1]}"


def test_a_full_disk_is_lacking(bare_workplace, capsys):
    assert run_command("doctor", ["least_free_gb=1000000000"]) == 2
    assert "lacking: disk" in capsys.readouterr().err


def test_a_machine_that_has_what_it_needs_is_told_so_and_nothing_is_made(bare_workplace, capsys):
    remote(bare_workplace, "s3://bucket/folder")
    assert run_command("doctor", []) == 0
    shown, error = capsys.readouterr()
    assert "✗" not in shown
    assert not error
    assert "lab, s3://bucket/folder" in shown
    assert [path.name for path in bare_workplace.iterdir()] == [".dvc"]
