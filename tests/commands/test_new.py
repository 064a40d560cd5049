"""A lab's own project: what `swarmtwin new` lays out is whole, and its pipeline runs where swarmtwin is installed."""

import os
import re
import shutil
import site
import subprocess
import sys
from pathlib import Path

import hydra
import pytest
import yaml

from swarmtwin.commands.app import run_command
from swarmtwin.configuration import let_hydra_find_plugins
from swarmtwin.recordings.reading import read_recording
from swarmtwin.robot import Robot

REPOSITORY = Path(__file__).resolve().parents[2]


def test_a_project_has_a_robot_a_recording_of_it_and_a_pipeline(bare_workplace, robots, capsys):
    assert run_command("new", ["my-lab", "name=crawler", "runs=8", "steps=5"]) == 0
    project = bare_workplace / "my-lab"
    robot = Robot.load(project / "conf" / "robot" / "crawler.yaml")
    assert robot == robots["mgr"].model_copy(update={"name": "crawler"})
    assert len(read_recording(project / "data" / "first_recording", robot).runs) == 8
    assert "next: cd my-lab && dvc repro" in capsys.readouterr().out
    tracked = subprocess.run(["git", "status", "--porcelain"], cwd=project, capture_output=True, text=True).stdout
    assert "data.dvc" in tracked
    assert "data/" not in tracked.replace("data.dvc", "")


def test_its_stages_call_commands_with_options_that_they_have(bare_workplace, monkeypatch):
    """Each stage's command is composed, from the project's own folder of choices."""
    assert run_command("new", ["my-lab", "runs=8", "steps=5"]) == 0
    project = bare_workplace / "my-lab"
    monkeypatch.setenv("SWARMTWIN_PLUGINS", str(project))
    let_hydra_find_plugins()
    content = yaml.safe_load((project / "dvc.yaml").read_text())
    variables = {name: value for one in content["vars"] for name, value in one.items()}
    with hydra.initialize_config_dir(str(REPOSITORY / "conf"), version_base="1.3"):
        for stage in content["stages"].values():
            call = stage["cmd"].replace("${item.model}", variables["models"][0])
            for name, value in variables.items():
                call = call.replace(f"${{{name}}}", str(value))
            command, *options = call.partition(" swarmtwin ")[2].split()
            assert hydra.compose(command, options).robot.name == "my_robot"
    assert {file.partition("/")[0] for file in content["metrics"]} == {"artifacts"}


@pytest.mark.parametrize(("folder", "project"), [("my-lab", "my-lab"), ("Müller's #1 lab", "Müller_s_1_lab")])
def test_its_runs_carry_its_name(bare_workplace, folder, project):
    """In the pipeline, and in a shell where what the README says was typed."""
    assert run_command("new", [f'output="{folder}"', "runs=8", "steps=5"]) == 0
    variables = yaml.safe_load((bare_workplace / folder / "dvc.yaml").read_text())["vars"]
    (call,) = (one["swarmtwin"] for one in variables if "swarmtwin" in one)
    readme = (bare_workplace / folder / "README.md").read_text()
    (export,) = re.findall("^export .*$", readme, re.MULTILINE)
    for said in (f"{call.removesuffix('swarmtwin')} env", f"{export}; env"):
        shown = subprocess.run(["sh", "-c", said], capture_output=True, text=True, check=True).stdout
        assert f"SWARMTWIN_PROJECT={project}\n" in shown


def test_a_recording_of_ones_own_becomes_the_first(bare_workplace, capsys):
    assert run_command("record", ["runs=8", "steps=5", "output=mine"]) == 0
    shutil.copy("mine/recording.yaml", "before.yaml")
    assert run_command("new", ["my-lab", "recording=mine"]) == 0
    project = bare_workplace / "my-lab"
    assert (
        len(read_recording(project / "data/first_recording", Robot.load(project / "conf/robot/my_robot.yaml")).runs)
        == 8
    )
    assert Path("mine/recording.yaml").read_text() == Path("before.yaml").read_text()


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["my-lab", "name=mur"], "name=mur is a robot that swarmtwin brings: give the lab's own another name"),
        (["my-lab", "name=My-Robot"], "name"),
        (["my-lab", "robot=create"], "robot 'create' has no stand-in"),
        (["my-lab", "recording=nowhere"], "nowhere"),
        ([], "option 'output' is missing: add output=..."),
        (["taken"], "already holds something: choose another"),
    ],
)
def test_a_mistake_is_one_line_and_leaves_nothing(bare_workplace, capsys, arguments, message):
    (bare_workplace / "taken").mkdir()
    (bare_workplace / "taken" / "thesis.txt").write_text("mine")
    assert run_command("new", arguments) == 2
    error = capsys.readouterr().err
    assert message in error
    assert len(error.splitlines()) == 1
    assert [path.name for path in bare_workplace.iterdir()] == ["taken"]


@pytest.mark.claims
def test_its_pipeline_runs_with_the_installed_wheel(tmp_path):
    """In an environment in which swarmtwin is installed, with nothing of the checkout on the path."""
    wheel = [sys.executable, "-m", "pip", "wheel", "--quiet", "--no-deps", "--wheel-dir", tmp_path, REPOSITORY]
    if subprocess.run(wheel, capture_output=True).returncode:
        pytest.skip("no wheel can be built here: its build back end cannot be fetched")
    subprocess.run([sys.executable, "-m", "venv", tmp_path / "environment"], check=True)
    binaries = tmp_path / "environment" / "bin"
    (packages,) = (tmp_path / "environment").glob("lib/python*/site-packages")
    (packages / "others.pth").write_text("\n".join(site.getsitepackages()))  # what it needs, installed there already
    install = [binaries / "pip", "install", "--quiet", "--no-deps", *tmp_path.glob("*.whl")]
    subprocess.run(install, check=True)
    left_out = ("PYTHONPATH", "SWARMTWIN_PLUGINS", "SWARMTWIN_PROJECT", "SWARMTWIN_PRELOADED", "MLFLOW_TRACKING_URI")
    environment = {name: value for name, value in os.environ.items() if name not in left_out}
    environment["PATH"] = f"{binaries}:{environment['PATH']}"

    def call(*command, folder=tmp_path):
        answer = subprocess.run(command, cwd=folder, env=environment, capture_output=True, text=True)
        assert answer.returncode == 0, answer.stderr
        return answer.stdout

    where = call("python", "-c", "import swarmtwin; print(swarmtwin.__file__)").strip()
    assert Path(where).is_relative_to(tmp_path)
    call("swarmtwin", "new", "my-lab")
    project = tmp_path / "my-lab"
    call("python", "-m", "dvc", "repro", "--quiet", folder=project)
    for model in ("kinematic", "mlp"):
        assert (project / "artifacts" / "evaluation" / model / "metrics.json").is_file()
    assert (project / "mlruns" / "my-lab" / "dynamics").is_dir()
    assert "didn't change" in call("python", "-m", "dvc", "repro", folder=project)
