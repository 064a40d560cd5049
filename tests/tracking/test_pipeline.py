"""dvc.yaml: every stage can run, hangs on all that shapes it, and reruns only when some of that changed."""

import functools
import itertools
import json
import os
import shutil
import subprocess
import sys
import time
from pathlib import Path

import hydra
import mlflow
import pandas as pd
import pytest
import yaml
from hydra.core.override_parser.overrides_parser import OverridesParser
from omegaconf import OmegaConf

from preloaded import preloaded_dvc, preloaded_program
from swarmtwin.commands.app import run_command
from swarmtwin.standin.physics import Physics
from swarmtwin.tracking.bare_code import digest
from swarmtwin.tracking.pipeline import DRAWING, Pipeline, with_digest

REPOSITORY = Path(__file__).resolve().parents[2]
FILE = yaml.safe_load((REPOSITORY / "dvc.yaml").read_text())
AFFORDED = yaml.safe_load((REPOSITORY / "conf" / "pipeline.yaml").read_text())
PIPELINE = Pipeline(REPOSITORY)
STAGES = PIPELINE.stages
DRAWN = ("pictures@mgr-comparison", "pictures@mgr-dynamics")
every_stage = pytest.mark.parametrize("stage", STAGES.values(), ids=STAGES)


def names(group):
    return {file.stem for file in (REPOSITORY / "conf" / group).glob("*.yaml")}


def code(stage):
    """The code that a stage hangs on, as paths below `src/swarmtwin/`."""
    return {str(file.relative_to("src/swarmtwin")) for file in PIPELINE.code[stage]}


@functools.cache
def composed(name):
    """The stage's configuration as Hydra puts it together, and the choices of groups in it."""
    stage = STAGES[name]
    with hydra.initialize_config_dir(str(REPOSITORY / "conf"), version_base="1.3"):
        config = hydra.compose(stage.config_name, list(stage.arguments[1:]), return_hydra_config=True)
    return config, dict(config.hydra.runtime.choices)


def test_what_the_pipeline_is_run_for_exists():
    assert set(AFFORDED["robots"]) <= names("robot")
    assert set(AFFORDED["models"]) <= names("model")
    assert set(AFFORDED["generators"]) <= names("generator")
    assert set(AFFORDED["policies"]) <= names("task")
    assert {policy["robot"] for policy in AFFORDED["policies"].values()} <= set(AFFORDED["robots"])


def test_every_recorded_robot_is_in_the_pipeline():
    if not (REPOSITORY / "data").is_dir():
        pytest.skip("no data/: dvc pull")
    recorded = {folder.name: folder for folder in (REPOSITORY / "data").iterdir() if folder.is_dir()}
    assert set(AFFORDED["robots"]) == set(recorded)
    later = {name for name, folder in recorded.items() if (folder / "later_session").is_dir()}
    assert set(AFFORDED["diagnosed_robots"]) == later
    assert set(AFFORDED["filmed_robots"]) == {name for name, folder in recorded.items() if (folder / "clip").is_dir()}


def test_the_file_holds_the_digest_of_its_stages():
    text = (REPOSITORY / "dvc.yaml").read_text()
    assert with_digest(text) == text, "run `make dependencies`"
    assert with_digest(text.replace("model=crnet", "model=gru")) != with_digest(text).replace(
        "model=crnet", "model=gru"
    )
    assert "${digest_of_stages}" in FILE["stages"]["code"]["cmd"]


def test_a_stage_hangs_on_its_own_plugins_alone():
    assert "dynamics/models/crnet.py" in code("dynamics@mgr-crnet")
    assert "dynamics/models/gru.py" not in code("dynamics@mgr-crnet")
    assert "generators/models/gan.py" not in code("synthetic@mgr-residual_diffusion")
    assert "kinematics/tail_fin.py" not in code("dynamics@mgr-kinematic")
    assert "policies/algorithms/ppo.py" not in code("policies@collective")


def test_a_stage_hangs_on_the_plugins_of_those_that_it_reads():
    assert {"dynamics/models/crnet.py"} == {
        file for file in code("policies@pair") if file.startswith("dynamics/models/c")
    }
    for model in AFFORDED["models"]:
        assert f"dynamics/models/{model}.py" in code("comparison@mgr")


@pytest.mark.parametrize("name", STAGES)
def test_every_stage_hangs_on_what_all_computing_stands_on(name):
    assert {"geometry.py", "robot.py", "transitions/transitions.py"} <= code(name)


@pytest.mark.parametrize("name", STAGES)
def test_drawing_is_done_by_stages_of_its_own(name):
    drawing = {file for file in code(name) if any(Path(file).match(pattern) for pattern in DRAWING)}
    assert PIPELINE.is_drawing(name) == bool(drawing) == (STAGES[name].template in ("pictures", "report"))
    assert not (drawing and any(name in stage.upstream for stage in STAGES.values()))


def test_every_stage_that_computes_leaves_drawing_to_another_and_is_drawn():
    drawn = {other for stage in STAGES.values() if PIPELINE.is_drawing(stage.name) for other in stage.upstream}
    undrawn = ("tracked", "tables")  # tracking a film draws nothing, and a text file is none
    computing = {name for name in STAGES if not PIPELINE.is_drawing(name) and STAGES[name].template not in undrawn}
    assert drawn == computing
    assert all(STAGES[name].options["pictures"] == "false" for name in computing)


@pytest.mark.parametrize("file", ["dynamics/error_plots.py", "diagnosis/report/page.py", "world/rendering/video.py"])
def test_only_drawing_stages_hang_on_what_draws(file):
    assert {STAGES[name].template for name in STAGES if file in code(name)} == {"pictures", "report"}


def test_a_training_hangs_on_what_trains():
    training = [name for name in STAGES if "dynamics/training_module.py" in code(name)]
    assert {STAGES[name].template for name in training} == {"dynamics", "synthetic_dynamics", "real_and_synthetic"}


@pytest.mark.parametrize("pattern", DRAWING)
def test_every_pattern_of_pictures_and_reports_fits_a_file(pattern):
    assert any(file.match(pattern) for file in (REPOSITORY / "src").rglob("*") if file.is_file())


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
    config, _ = composed(stage.name)
    assert not [key for key in config if key != "hydra" and OmegaConf.is_missing(config, key)]
    assert [config.output] == list(stage.outs)


@every_stage
def test_a_stage_chooses_what_hydra_composes_of_it(stage):
    _, choices = composed(stage.name)
    for group, chosen in PIPELINE.choices[stage.name].items():
        assert chosen == {choice for key, choice in choices.items() if key.partition("@")[0] == group and choice}


@every_stage
def test_a_stage_hangs_on_the_choices_of_its_command(stage):
    """A robot's file shapes the transitions, which hold it; what follows hangs on it through them."""
    _, choices = composed(stage.name)
    shaping = {
        "prepare": ("robot", "split"),
        "track": ("robot",),
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
    config, _ = composed(stage.name)
    names = (
        *("recording", "transitions", "generators", "models", "simulation", "policies"),
        *("train_vehicle", "other_vehicle", "open_loop"),
        *("reference", "measured", "folder"),
    )
    read = [config[name] for name in names if isinstance(config.get(name), str)]
    read += [] if isinstance(config.get("models"), str | None) else config.models
    if stage.arguments[0] in ("train", "generate") and not config.transitions:
        read = [f"artifacts/transitions/{config.robot.name}"]
    if stage.arguments[0] == "track":
        read = [config.video, config.commands, config.calibration]
    if stage.template == "tables":
        made = ("comparison", "real_and_synthetic", "policies", "transfer")
        read = [f"{config.artifacts}/{folder}/{config.robot.name}" for folder in made]
    assert read
    for folder in read:
        assert any(Path(folder).is_relative_to(dependency) for dependency in stage.deps), folder


@pytest.mark.parametrize("robot", AFFORDED["robots"])
def test_a_stage_hangs_on_the_file_that_tells_its_code(robot, tmp_path):
    PIPELINE.write_code(robot, tmp_path)
    own = {stage.code_file: stage for stage in STAGES.values() if stage.items["robot"] == robot}
    assert {file.name for file in tmp_path.iterdir()} == own.keys()
    for name, stage in own.items():
        assert [path for path in stage.deps if "code" in path] == [f"artifacts/code/{robot}/{name}"]
        told = dict(reversed(line.split("  ")) for line in (tmp_path / name).read_text().splitlines())
        assert told.keys() == {str(file) for file in PIPELINE.code[stage.name]}
        assert all(told[file] == digest(REPOSITORY / file) for file in list(told)[::20])


@pytest.mark.parametrize("kind", ["metrics", "plots"])
def test_metrics_and_plots_lie_in_what_a_stage_makes(kind):
    made = [out for stage in STAGES.values() for out in stage.outs]
    for entry in FILE[kind]:
        path = entry if isinstance(entry, str) else next(iter(entry))
        assert any(Path(path).is_relative_to(out) for out in made), path


@pytest.fixture(scope="module")
def repository(tmp_path_factory):
    """A small copy of this repository: two models, few steps, tiny recordings; `dvc repro` has run for the MGR."""
    folder = tmp_path_factory.mktemp("repository")
    for name in ("conf", "src"):
        shutil.copytree(REPOSITORY / name, folder / name, ignore=shutil.ignore_patterns("__pycache__"))
    shutil.copy(REPOSITORY / "dvc.yaml", folder)
    for model in ("kinematic", "mlp"):
        change(folder / "conf" / "model" / f"{model}.yaml", steps=20)
    change(folder / "conf" / "recipe" / "fast.yaml", batch_size=128)
    for model in ("crnet", "mlp"):
        change(folder / "conf" / "model" / f"{model}.yaml", steps=20)
    change(folder / "conf" / "generator" / "residual_diffusion.yaml", members=2, mean_model_steps=20, noise_steps=20)
    change(folder / "conf" / "pipeline.yaml", models=["kinematic", "mlp"], synthetic_transitions=400)
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(Physics, "bank_rows", 2048)
        for robot, (number, recording) in itertools.product(
            ("mgr", "mur"), enumerate(("reference", "other_vehicle", "open_loop"))
        ):
            options = [f"robot={robot}", "runs=20", "steps=15", f"seed={number + 1}"]
            output = f"output={folder}/data/{robot}/{recording}"
            assert run_command("record", [*options, output]) == 0
    call(folder, "git", "init", "--quiet")
    (folder / ".gitignore").write_text("/.venv/\n/mlflow.db*\n/mlruns/\n*.partial\n__pycache__/\n")
    (folder / ".venv" / "bin").mkdir(parents=True)
    programs, source = folder / ".venv" / "bin", folder / "src"
    with preloaded_program(programs / "swarmtwin", source), preloaded_dvc(programs / "dvc", source):
        dvc(folder, "init", "--quiet")
        shutil.copy(REPOSITORY / ".dvcignore", folder)
        dvc(folder, "repro", "--quiet", *DRAWN)
        yield folder


def change(file, **values):
    """Set values in a YAML file."""
    file.write_text(yaml.safe_dump(yaml.safe_load(file.read_text()) | values, sort_keys=False))


def call(folder, *command):
    environment = {**os.environ, "DVC_NO_ANALYTICS": "true", "GIT_CONFIG_GLOBAL": os.devnull}
    environment.pop("MLFLOW_TRACKING_URI", None)
    environment["PATH"] = f"{Path(sys.executable).parent}{os.pathsep}{environment['PATH']}"  # DVC's workers call it
    answer = subprocess.run(command, cwd=folder, env=environment, capture_output=True, text=True, check=False)
    assert answer.returncode == 0, answer.stdout + answer.stderr
    return answer.stdout


def dvc(folder, *arguments):
    return call(folder, folder / ".venv" / "bin" / "dvc", *arguments)


def reran(folder, *targets):
    """Reproduce; return the names of the stages that ran."""
    shown = dvc(folder, "repro", *targets)
    return {line.split("'")[1] for line in shown.splitlines() if line.startswith("Running stage")}


def stale(folder, *targets):
    """Return the names of the stages, among those that lead to targets, whose code, data or parameters have changed."""
    dvc(folder, "repro", "code@mgr")
    changed = json.loads(dvc(folder, "status", "--json", "--with-deps", *targets))
    return {name for name, reasons in changed.items() if any("changed deps" in reason for reason in reasons)}


@pytest.mark.end_to_end
def test_the_pipeline_runs_and_a_second_time_does_nothing(repository):
    table = pd.read_csv(repository / "artifacts" / "comparison" / "mgr" / "table.csv")
    assert set(table.model) == {"kinematic", "mlp", "crnet-S"}
    assert not list((repository / "artifacts" / "comparison").rglob("*.png"))
    pictures = repository / "artifacts" / "pictures"
    assert (pictures / "comparison" / "mgr" / "errors_train_vehicle.png").exists()
    assert (pictures / "dynamics" / "mgr" / "crnet_synthetic" / "history.png").exists()
    assert reran(repository, *DRAWN) == set()


@pytest.mark.end_to_end
def test_metrics_are_shown_as_a_table_that_fits_a_window(repository):
    heading, *rows = dvc(repository, "metrics", "show", "artifacts/comparison/mgr/summary").strip().splitlines()
    figures = ["Path", "floor_mm", "open_loop_mm", "orientation_deg", "other_vehicle_mm", "position_mm"]
    assert heading.split() == figures
    assert [Path(row.split()[0]).stem for row in rows] == ["crnet-S", "kinematic", "mlp"]
    assert max(map(len, [heading, *rows])) < 140


@pytest.mark.end_to_end
def test_a_changed_model_reruns_only_that_model_and_the_comparison(repository):
    artifacts = repository / "artifacts" / "dynamics" / "mgr"
    before = {name: (artifacts / name / "history.csv").read_bytes() for name in ("kinematic", "mlp")}
    change(repository / "conf" / "model" / "mlp.yaml", steps=30)
    assert reran(repository, *DRAWN) == {"code@mgr", "dynamics@mgr-mlp", "comparison@mgr", *DRAWN}
    assert (artifacts / "kinematic" / "history.csv").read_bytes() == before["kinematic"]
    assert len(pd.read_csv(artifacts / "mlp" / "history.csv")) > before["mlp"].count(b"\n") - 1
    assert reran(repository, *DRAWN) == set()


@pytest.mark.end_to_end
def test_a_sentence_or_another_layout_makes_nothing_stale(repository):
    file = repository / "src" / "swarmtwin" / "geometry.py"
    file.write_text(f"# A sentence.\n{file.read_text().replace('def compose(', 'def  compose(  ')}\n# and another\n")
    assert reran(repository, *DRAWN) == {"code@mgr"}


@pytest.mark.end_to_end
def test_a_line_in_a_plot_draws_anew_and_computes_nothing(repository):
    add_line(repository / "src" / "swarmtwin" / "dynamics" / "error_plots.py")
    assert stale(repository, *DRAWN) == set(DRAWN)


@pytest.mark.end_to_end
def test_a_line_in_a_model_a_training_or_the_geometry_makes_stale_what_it_shapes(repository):
    source = repository / "src" / "swarmtwin"
    add_line(source / "dynamics" / "models" / "mlp.py")
    assert stale(repository, "comparison@mgr") == {"dynamics@mgr-mlp", "comparison@mgr"}
    add_line(source / "dynamics" / "training_module.py")
    trainings = {"dynamics@mgr-mlp", "dynamics@mgr-kinematic", "synthetic_dynamics@mgr"}
    assert stale(repository, "comparison@mgr") == {*trainings, "comparison@mgr"}
    add_line(source / "geometry.py")
    leading_there = {
        "transitions@mgr",
        "synthetic@mgr-residual_diffusion",
        "dynamics@mgr-kinematic",
        "synthetic_dynamics@mgr",
    }
    assert stale(repository, "comparison@mgr") >= leading_there


@pytest.mark.end_to_end
def test_queued_experiments_compute_with_their_own_parameters(repository):
    """Each in a copy of the repository, two at a time; what they track is in the one MLflow store."""
    name, steps = "dynamics@mgr-mlp", (25, 35)
    identity = ("-c", "user.name=x", "-c", "user.email=x@y")
    call(repository, "git", *identity, "add", "--all")
    call(repository, "git", *identity, "commit", "--quiet", "--message", "baseline")
    for count in steps:
        dvc(
            repository, "exp", "run", "--queue", "--name", f"s{count}", "-S", f"conf/model/mlp.yaml:steps={count}", name
        )
    dvc(repository, "queue", "start", "--jobs", "2")
    deadline = time.monotonic() + 240
    while "Running" in (status := dvc(repository, "queue", "status")) or "Queued" in status:
        assert time.monotonic() < deadline, status
        time.sleep(2)
    assert status.count("Success") == len(steps), status
    for count in steps:
        described = yaml.safe_load(output_of(repository, f"s{count}", name, "model.yaml"))
        assert described["model"]["steps"] == count
    store = f"sqlite:///{repository / 'mlflow.db'}"
    client = mlflow.MlflowClient(store)
    experiment = client.get_experiment_by_name("swarmtwin/dynamics")
    runs = client.search_runs([experiment.experiment_id], filter_string="params.`model.name` = 'mlp'")
    assert set(map(str, steps)) <= {run.data.params["model.steps"] for run in runs}
    for run in runs:
        (output,) = run.outputs.model_outputs
        kept = Path(client.get_logged_model(output.model_id).artifact_location.removeprefix("file://"))
        assert kept.is_relative_to(repository / "mlruns" / "swarmtwin" / "dynamics")
        assert (kept / "data" / "model" / "model.yaml").exists()


def output_of(folder, experiment, stage, file):
    """The content of a file that a stage left in an experiment, out of DVC's cache."""
    references = call(folder, "git", "for-each-ref", "--format=%(refname)", "refs/exps").split()
    reference = next(name for name in references if name.endswith(f"/{experiment}"))
    (out,) = yaml.safe_load(call(folder, "git", "show", f"{reference}:dvc.lock"))["stages"][stage]["outs"]
    cache = folder / ".dvc" / "cache" / "files" / "md5"
    listed = json.loads((cache / out["md5"][:2] / out["md5"][2:]).read_text())
    digest = next(entry["md5"] for entry in listed if entry["relpath"] == file)
    return (cache / digest[:2] / digest[2:]).read_text()


def add_line(file):
    file.write_text(file.read_text() + "\nANOTHER_LINE = True\n")
