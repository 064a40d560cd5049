"""dvc.yaml: every stage can run, hangs on all that shapes it, and reruns only when some of that changed."""

import itertools
import os
import shlex
import shutil
import subprocess
import sys
from pathlib import Path
from typing import NamedTuple

import hydra
import pandas as pd
import pytest
import yaml
from hydra.core.override_parser.overrides_parser import OverridesParser
from omegaconf import OmegaConf

from swarmtwin.commands import COMMANDS
from swarmtwin.commands.app import run_command
from swarmtwin.standin import truth

REPOSITORY = Path(__file__).resolve().parents[1]
PIPELINE = yaml.safe_load((REPOSITORY / "dvc.yaml").read_text())
AFFORDED = yaml.safe_load((REPOSITORY / "conf" / "pipeline.yaml").read_text())


class Stage(NamedTuple):
    """A stage with its places filled in: for one robot, one model, one policy."""

    name: str
    arguments: list[str]
    deps: list[str]
    params: dict[str, list[str] | None]
    outs: list[str]

    @property
    def options(self):
        return dict(argument.split("=", 1) for argument in self.arguments[1:])


def filled_in():
    """Name and content of every stage."""
    for name, template in PIPELINE["stages"].items():
        if "foreach" in template:
            for key, item in template["foreach"].items():
                values = {"key": key, **{f"item.{field}": value for field, value in item.items()}}
                yield f"{name}@{key}", with_values(template["do"], values)
            continue
        content = {key: value for key, value in template.items() if key != "matrix"}
        for chosen in itertools.product(*template["matrix"].values()):
            values = {f"item.{key}": value for key, value in zip(template["matrix"], chosen, strict=True)}
            yield f"{name}@{'-'.join(chosen)}", with_values(content, values)


def with_values(content, values):
    """A stage's content with its places filled in."""
    text = yaml.safe_dump(content, width=1000)
    for key, value in {**AFFORDED, **values}.items():
        text = text.replace(f"${{{key}}}", str(value))
    return yaml.safe_load(text)


def stages():
    for name, stage in filled_in():
        program, *words = shlex.split(stage["cmd"])
        assert program == "${swarmtwin}"
        params = {file: keys for entry in stage["params"] for file, keys in entry.items()}
        outs = [path for out in stage["outs"] for path in out]
        yield Stage(name, words, stage["deps"], params, outs)


STAGES = {stage.name: stage for stage in stages()}
every_stage = pytest.mark.parametrize("stage", STAGES.values(), ids=STAGES)


def composed(stage):
    """The stage's configuration as Hydra puts it together, and the choices of groups in it."""
    name = f"experiment/{stage.options['name']}" if stage.arguments[0] == "experiment" else stage.arguments[0]
    with hydra.initialize_config_dir(str(REPOSITORY / "conf"), version_base="1.3"):
        config = hydra.compose(name, stage.arguments[1:], return_hydra_config=True)
    return config, dict(config.hydra.runtime.choices)


def test_every_model_there_is_is_trained_and_every_robot_that_was_recorded():
    dynamics = PIPELINE["stages"]["dynamics"]["matrix"]
    assert sorted(dynamics["model"]) == sorted(path.stem for path in (REPOSITORY / "conf" / "model").glob("*.yaml"))
    robots = {
        tuple(stage["matrix"]["robot"])
        for name, stage in PIPELINE["stages"].items()
        if "matrix" in stage and name != "diagnosis"  # of the robots with a later session
    }
    assert robots == {tuple(dynamics["robot"])}
    later = {path.parent.name for path in (REPOSITORY / "data").glob("*/later_session")} or {"mgr"}
    assert set(PIPELINE["stages"]["diagnosis"]["matrix"]["robot"]) == later


def test_every_generator_there_is_is_trained_and_every_task_learned():
    generators = PIPELINE["stages"]["synthetic"]["matrix"]["generator"]
    assert sorted(generators) == sorted(path.stem for path in (REPOSITORY / "conf" / "generator").glob("*.yaml"))
    tasks = PIPELINE["stages"]["policies"]["foreach"]
    assert sorted(tasks) == sorted(path.stem for path in (REPOSITORY / "conf" / "task").glob("*.yaml"))


def test_both_robots_have_their_recordings():
    dynamics = PIPELINE["stages"]["dynamics"]["matrix"]
    if (REPOSITORY / "data").is_dir():
        assert sorted(dynamics["robot"]) == sorted(
            path.name for path in (REPOSITORY / "data").iterdir() if path.is_dir()
        )


@every_stage
def test_the_parameters_a_stage_hangs_on_exist(stage):
    for file, keys in stage.params.items():
        content = yaml.safe_load((REPOSITORY / file).read_text())
        assert content
        for key in keys or []:
            assert key in content


@every_stage
def test_a_stage_calls_its_command_with_options_that_exist(stage):
    OverridesParser.create().parse_overrides(stage.arguments[1:])
    config, _ = composed(stage)
    assert not [key for key in config if key != "hydra" and OmegaConf.is_missing(config, key)]
    assert [config.output] == stage.outs


@every_stage
def test_a_stage_hangs_on_the_choices_of_its_command(stage):
    """A robot's file shapes the transitions, which hold it; what follows hangs on it through them."""
    _, choices = composed(stage)
    shaping = {
        "prepare": ("robot", "split"),
        "generate": ("generator",),
        "train": ("model", "recipe"),
        "learn": ("task", "policy"),
        "diagnose": ("robot",),
        "experiment": tuple(group for group in choices if group in ("recipe", "model@crnet", "generator@generator")),
    }
    for group in shaping[stage.arguments[0]]:
        assert f"conf/{group.split('@')[0]}/{choices[group]}.yaml" in stage.params


@every_stage
def test_a_stage_hangs_on_the_folders_that_its_command_reads(stage):
    config, _ = composed(stage)
    names = (
        *("recording", "transitions", "generators", "models", "simulation", "policies"),
        *("train_vehicle", "other_vehicle", "open_loop"),
        *("reference", "measured"),
    )
    read = [config[name] for name in names if config.get(name)]
    if stage.arguments[0] in ("train", "generate") and not config.transitions:
        read = [f"artifacts/transitions/{config.robot.name}"]
    assert read
    for folder in read:
        assert any(Path(folder).is_relative_to(dependency) for dependency in stage.deps), folder


@every_stage
def test_code_that_a_stage_hangs_on_exists(stage):
    assert not [path for path in stage.deps if path.startswith("src/") and not (REPOSITORY / path).exists()]


@pytest.mark.parametrize("kind", ["metrics", "plots"])
def test_metrics_and_plots_lie_in_what_a_stage_makes(kind):
    made = [out for stage in STAGES.values() for out in stage.outs]
    for entry in PIPELINE[kind]:
        path = entry if isinstance(entry, str) else next(iter(entry))
        assert any(Path(path).is_relative_to(out) for out in made), path


@pytest.fixture(scope="module")
def repository(tmp_path_factory):
    """A small copy of this repository: two models, few steps, tiny recordings; `dvc repro` has run for the MGR."""
    folder = tmp_path_factory.mktemp("repository")
    for name in ("conf", "src"):
        shutil.copytree(REPOSITORY / name, folder / name, ignore=shutil.ignore_patterns("__pycache__"))
    small = (REPOSITORY / "dvc.yaml").read_text().replace(str_of_models(), "model: [kinematic, mlp]")
    (folder / "dvc.yaml").write_text(small)
    for model in ("kinematic", "mlp"):
        change(folder / "conf" / "model" / f"{model}.yaml", steps=20)
    change(folder / "conf" / "recipe" / "fast.yaml", batch_size=128)
    for model in ("crnet", "mlp"):
        change(folder / "conf" / "model" / f"{model}.yaml", steps=20)
    change(folder / "conf" / "generator" / "diffusion.yaml", members=2, trend_steps=20, noise_steps=20)
    change(folder / "conf" / "pipeline.yaml", synthetic_transitions=400)
    program = folder / ".venv" / "bin" / "swarmtwin"
    program.parent.mkdir(parents=True)
    program.write_text(f'#!/bin/sh\nPYTHONPATH={folder}/src exec {sys.executable} -m swarmtwin_here "$@"\n')
    program.chmod(0o755)
    (folder / "src" / "swarmtwin_here.py").write_text("from swarmtwin.commands import main\nmain()\n")
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(truth, "BANK_ROWS", 2048)
        for robot, (number, recording) in itertools.product(
            ("mgr", "mur"), enumerate(("reference", "other_vehicle", "open_loop"))
        ):
            options = [f"robot={robot}", "runs=20", "steps=15", f"seed={number + 1}"]
            output = f"output={folder}/data/{robot}/{recording}"
            assert run_command("record", COMMANDS["record"].module, [*options, output]) == 0
    call(folder, "git", "init", "--quiet")
    dvc(folder, "init", "--quiet")
    dvc(folder, "repro", "--quiet", "comparison@mgr")
    return folder


def str_of_models():
    return f"model: [{', '.join(PIPELINE['stages']['dynamics']['matrix']['model'])}]"


def change(file, **values):
    """Set values in a YAML file."""
    file.write_text(yaml.safe_dump(yaml.safe_load(file.read_text()) | values, sort_keys=False))


def call(folder, *command):
    environment = {**os.environ, "DVC_NO_ANALYTICS": "true", "GIT_CONFIG_GLOBAL": os.devnull}
    environment.pop("MLFLOW_TRACKING_URI", None)
    answer = subprocess.run(command, cwd=folder, env=environment, capture_output=True, text=True, check=False)
    assert answer.returncode == 0, answer.stdout + answer.stderr
    return answer.stdout


def dvc(folder, *arguments):
    return call(folder, sys.executable, "-m", "dvc", *arguments)


def reran(folder, *targets):
    """Reproduce; return the names of the stages that ran."""
    shown = dvc(folder, "repro", *targets)
    return {line.split("'")[1] for line in shown.splitlines() if line.startswith("Running stage")}


def test_the_pipeline_runs_and_a_second_time_does_nothing(repository):
    table = pd.read_csv(repository / "artifacts" / "comparison" / "mgr" / "table.csv")
    assert set(table.model) == {"kinematic", "mlp", "crnet-S"}
    assert reran(repository, "comparison@mgr") == set()


def test_a_changed_model_reruns_only_that_model_and_the_comparison(repository):
    artifacts = repository / "artifacts" / "dynamics" / "mgr"
    before = {name: (artifacts / name / "history.csv").read_bytes() for name in ("kinematic", "mlp")}
    change(repository / "conf" / "model" / "mlp.yaml", steps=30)
    assert reran(repository, "comparison@mgr") == {"dynamics@mgr-mlp", "comparison@mgr"}
    assert (artifacts / "kinematic" / "history.csv").read_bytes() == before["kinematic"]
    assert len(pd.read_csv(artifacts / "mlp" / "history.csv")) > before["mlp"].count(b"\n") - 1
    assert reran(repository, "comparison@mgr") == set()
