"""Sweeps as users of Hydra know them: launchers, ranges and globs, choices of one's own, completion in a shell."""

import importlib
import json
import os
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

from swarmtwin.commands.sweep_mistakes import check_sweep
from swarmtwin.configuration import config_files
from swarmtwin.errors import UserError

LAUNCHERS = {
    "joblib": "hydra_plugins.hydra_joblib_launcher",
    "submitit_local": "hydra_plugins.hydra_submitit_launcher",
    "ray": "ray",
}


def installed(launcher):
    try:
        importlib.import_module(LAUNCHERS[launcher])
    except ModuleNotFoundError:
        pytest.skip(f"hydra/launcher={launcher} is not installed")


def kept(folder):
    """The configuration that an output keeps of the run that made it."""
    return json.loads((folder / "provenance.json").read_text())["config"]


@pytest.fixture
def command(workshop):
    """Run a command as a user does, in a process of its own, in the workshop."""

    def call(*arguments, **environment):
        line = [sys.executable, "-m", "swarmtwin", *arguments]
        return subprocess.run(line, capture_output=True, text=True, env=os.environ | environment)

    return call


@pytest.fixture
def preloaded(program, workshop):
    """The same, where the process has its packages at once."""

    def call(*arguments, **environment):
        return subprocess.run([program, *arguments], capture_output=True, text=True, env=os.environ | environment)

    return call


@pytest.mark.parametrize(
    "launcher",
    [
        pytest.param("joblib", marks=pytest.mark.end_to_end),
        pytest.param("submitit_local", marks=pytest.mark.claims),
        pytest.param("ray", marks=pytest.mark.services),
    ],
)
def test_runs_side_by_side_leave_their_outputs_and_one_table(command, workshop, launcher):
    installed(launcher)
    sweep = ("recording=reference", "pictures=false", "split.seed=range(1,3)", "output=out/${split.seed}")
    answer = command("prepare", "-m", f"hydra/launcher={launcher}", *sweep)
    assert answer.returncode == 0, answer.stderr
    assert "2 runs" in answer.stdout
    assert [kept(workshop / "out" / seed)["split"]["seed"] for seed in ("1", "2")] == [1, 2]
    assert not list(Path("outputs/sweeps").glob(".rows-*"))


@pytest.mark.parametrize(
    "launcher",
    [
        *(pytest.param(name, marks=pytest.mark.claims) for name in ("joblib", "submitit_local")),
        pytest.param("ray", marks=pytest.mark.services),
    ],
)
def test_trainings_side_by_side_are_those_of_one_after_the_other(command, workshop, launcher):
    """To the last bit; and in MLflow they belong to the sweep's run, wherever they ran."""
    import mlflow

    installed(launcher)
    quick = ("recording=reference", "recipe.batch_size=256", "seeds=1", "register=false", "pictures=false")
    sweep = (*quick, "model=mlp", "model.steps=12,20")
    assert command("train", "-m", *sweep, "output=alone/${model.steps}").returncode == 0
    answer = command("train", "-m", f"hydra/launcher={launcher}", *sweep, "output=beside/${model.steps}")
    assert answer.returncode == 0, answer.stderr
    for steps in ("12", "20"):
        weights = [(workshop / place / steps / "weights.safetensors").read_bytes() for place in ("alone", "beside")]
        assert weights[0] == weights[1]
    mlflow.set_tracking_uri(f"sqlite:///{workshop / 'mlflow.db'}")
    runs = mlflow.search_runs(experiment_names=["swarmtwin/dynamics"], output_format="list")
    parents = [run.data.tags.get("mlflow.parentRunId") for run in runs]
    assert len(runs) == 6
    assert sorted(parents.count(run.info.run_id) for run in runs) == [0, 0, 0, 0, 2, 2]


def test_a_launcher_that_is_not_installed_is_one_line(preloaded):
    if importlib.util.find_spec("ray"):
        pytest.skip("Ray is installed")
    sweep = ("recording=reference", "pictures=false", "split.seed=1,2", "output=out/${split.seed}")
    answer = preloaded("prepare", "-m", "hydra/launcher=ray", *sweep)
    assert answer.returncode == 2
    assert "pip install 'swarmtwin[ray]'" in answer.stderr


def test_a_glob_is_each_of_the_choices_that_fit(workshop):
    """What is wrong with all of them is said before the first begins; with one that is right, nothing is."""
    check_sweep("train", "train", ["-m", "model=glob(*)", "recording=reference"])
    check_sweep("train", "train", ["-m", "model=glob([c*,m*],exclude=cnn)", "recording=reference"])
    with pytest.raises(UserError, match="nowhere"):
        check_sweep("train", "train", ["-m", "model=glob(*)", "recording=nowhere"])


def test_a_sweep_by_a_glob_takes_every_choice_of_a_folder_of_ones_own(preloaded, workshop):
    mine = workshop / "mine" / "split"
    mine.mkdir(parents=True)
    for seed in (5, 6):
        shutil.copy(config_files("split")["by_run"], mine / f"mine_{seed}.yaml")
        text = (mine / f"mine_{seed}.yaml").read_text()
        (mine / f"mine_{seed}.yaml").write_text(text.replace("seed: 1", f"seed: {seed}"))
    options = ("recording=reference", "pictures=false", "output=out/${split.seed}")
    answer = preloaded("prepare", "-m", "--config-dir=mine", "split=glob(mine_*)", *options)
    assert answer.returncode == 0, answer.stderr
    assert [kept(workshop / "out" / seed)["split"]["seed"] for seed in ("5", "6")] == [5, 6]
    shown = preloaded(
        "prepare", "--cfg", "job", "--config-dir=mine", "split=mine_5", "recording=reference", "output=out/x"
    )
    assert "seed: 5" in shown.stdout
    assert shown.returncode == 0


@pytest.mark.parametrize(
    ("line", "completed"),
    [
        ("swarmtwin tra", {"train", "track"}),
        ("swarmtwin train model=cr", {"model=crnet", "model=crnet_tuned"}),
        ("swarmtwin train robot=mgr recipe=pa", {"recipe=paper", "recipe=paper_mur"}),
        ("swarmtwin train model.drop", {"model.dropout="}),
        ("swarmtwin deploy safety.po", {"safety.pose_age_s="}),
        ("swarmtwin nonsense a", set()),
    ],
)
def test_what_is_typed_is_completed(preloaded, line, completed):
    answer = preloaded("--shell-completion", "query=bash", COMP_LINE=line)
    assert answer.returncode == 0, answer.stderr
    assert set(answer.stdout.split()) == completed


@pytest.mark.skipif(shutil.which("bash") is None, reason="there is no bash")
def test_bash_completes_after_it_has_evaluated_the_script(command, workshop):
    (workshop / "swarmtwin").write_text(f'#!/bin/sh\nexec {sys.executable} -m swarmtwin "$@"\n')
    (workshop / "swarmtwin").chmod(0o755)
    script = """eval "$(swarmtwin --shell-completion install=bash)"
    COMP_WORDS=(swarmtwin train model=cr) COMP_CWORD=2 COMP_LINE="swarmtwin train model=cr" COMP_POINT=24
    _swarmtwin_completion; echo "${COMPREPLY[@]}" """
    path = {"PATH": f"{workshop}:{os.environ['PATH']}"}
    answer = subprocess.run(["bash", "-c", script], capture_output=True, text=True, env=os.environ | path)
    assert answer.stdout.split() == ["model=crnet", "model=crnet_tuned"], answer.stderr


def test_another_shell_is_refused_in_one_line(command):
    answer = command("--shell-completion", "install=tcsh")
    assert answer.returncode == 2
    assert len(answer.stderr.splitlines()) == 1
