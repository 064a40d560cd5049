"""The console script: what every command does with options, mistakes and interruptions."""

import importlib
import signal
import subprocess
import sys
from importlib.resources import files
from pathlib import Path

import hydra
import pytest
from omegaconf import OmegaConf

from swarmtwin import commands
from swarmtwin.commands.app import run_command
from swarmtwin.commands.catalogue import COMMANDS
from swarmtwin.commands.experiment import experiments, study_module
from swarmtwin.commands.inputs import INPUTS
from swarmtwin.configuration import config_folder

SWARMTWIN = Path(sys.executable).with_name("swarmtwin")


@pytest.fixture
def recording(workplace):
    """A tiny recording of the MGR."""
    folder = workplace / "recording"
    (folder / "runs").mkdir(parents=True)
    header = "robot: mgr\nperiod_s: 0.5\narena_mm: {x: [0, 1030], y: [0, 1030]}\nsource: a test\n"
    (folder / "recording.yaml").write_text(header)
    for run in range(4):
        rows = [f"{30 * run + tick / 2},1,50,50,{100 + tick},{100 * run},0" for tick in range(10)]
        content = "\n".join(["time_s,vehicle,left,right,x_mm,y_mm,heading_rad", *rows]) + "\n"
        (folder / "runs" / f"run_{run}.csv").write_text(content)
    return folder


def call(*arguments):
    """Run a command in this process; return its exit status."""
    return run_command(arguments[0], list(arguments[1:]))


def test_a_command_runs_and_its_output_knows_its_configuration(recording, workplace):
    assert call("prepare", "robot=mgr", f"recording={recording}", "output=out") == 0
    assert '"command": "prepare"' in (workplace / "out" / "provenance.json").read_text()


@pytest.mark.parametrize(
    ("arguments", "status", "message"),
    [
        (["prepare", "recordin=x", "output=out"], 2, "unknown option 'recordin': did you mean 'recording'?"),
        (
            ["prepare", "robot.perod_s=1", "output=out"],
            2,
            "unknown option 'robot.perod_s': did you mean 'robot.period_s'?",
        ),
        (
            ["prepare", "robot=mgrr", "output=out"],
            2,
            "no such robot: 'mgrr': did you mean 'mgr'? known: car, create, mgr, mur",
        ),
        (["prepare", "splt.seed=1", "output=out"], 2, "unknown option 'splt.seed': did you mean 'split.seed'?"),
        (["train", "vehicles=[]", "recording=none", "output=out"], 2, "field 'vehicles': Tuple should have at least 1"),
        (["prepare", "output=out"], 2, "option 'recording' is missing: add recording=..."),
        (
            ["prepare", "recording=none", "output=out", "split.seed=x"],
            2,
            "field 'split.seed': Input should be a valid integer",
        ),
        (["prepare", "recording=none", "output=out"], 2, "no recording folder none"),
        (["experiment", "output=out"], 2, "say which: name=..."),
        (["experiment", "name=dynamcs"], 2, "no such experiment: 'dynamcs': did you mean 'dynamics'?"),
    ],
)
def test_a_mistake_is_one_line_that_names_the_remedy(workplace, capfd, arguments, status, message):
    assert call(*arguments) == status
    error = capfd.readouterr().err
    assert message in error
    assert len(error.strip().splitlines()) == 1
    assert "Traceback" not in error
    assert list(workplace.iterdir()) == []


def test_a_sweep_runs_each_value(recording, workplace):
    assert (
        call("prepare", "-m", "robot=mgr", f"recording={recording}", "split.seed=1,2", "output=out_${split.seed}") == 0
    )
    assert (workplace / "out_1").is_dir()
    assert (workplace / "out_2").is_dir()


@pytest.mark.parametrize(
    ("fault", "said"),
    [
        (OSError(28, "No space left on device"), "the disk is full: make room"),
        (
            PermissionError(13, "denied", "there/.out.lock.partial"),
            "another folder, or have it allowed (there); no",
        ),
        (OSError(36, "File name too long", "out"), "the name of a file is too long: choose a shorter one (out)"),
    ],
)
def test_a_fault_of_the_system_is_one_line(recording, workplace, capfd, monkeypatch, fault, said):
    def fail(*arguments):
        raise fault

    monkeypatch.setattr("swarmtwin.transitions.preparing.save_description", fail)
    assert call("prepare", "robot=mgr", f"recording={recording}", "output=out") == 2
    error = capfd.readouterr().err
    assert said in error
    assert "Traceback" not in error
    assert [path.name for path in workplace.iterdir()] == ["recording"]


@pytest.mark.parametrize("outputs_can_be_made", [True, False])
def test_a_defect_of_ours_is_one_line_that_names_the_log_with_its_traceback(
    recording, workplace, capfd, monkeypatch, outputs_can_be_made
):
    def fail(*arguments):
        raise ValueError("seven is not eight\nnor nine")

    monkeypatch.setattr("swarmtwin.transitions.preparing.save_description", fail)
    monkeypatch.setattr("tempfile.tempdir", str(recording))
    if not outputs_can_be_made:
        (workplace / "outputs").write_text("a file")
    assert call("prepare", "robot=mgr", f"recording={recording}", "output=out") == 1
    line = capfd.readouterr().err.strip().splitlines()[-1]
    assert line.startswith(
        "swarmtwin prepare: ValueError seven is not eight: a defect of swarmtwin; please report it with"
    )
    log = Path(line.split()[-1])
    assert log.parent == (Path("outputs/errors") if outputs_can_be_made else recording)
    assert "in fail" in log.read_text()
    assert log.read_text().startswith("swarmtwin prepare robot=mgr")
    assert not (workplace / "out").exists()


@pytest.mark.parametrize("stop", [signal.SIGINT, signal.SIGTERM])
def test_an_interrupted_command_leaves_nothing_and_the_next_one_works(recording, workplace, stop):
    hold = workplace / "hold.py"
    hold.write_text(
        "import sys, time\n"
        "import swarmtwin.transitions.preparing as preparing\n"
        "def wait(*arguments):\n    print('waiting', flush=True)\n"
        "    for _ in range(300):\n        time.sleep(0.1)\n"  # one long sleep goes on if a signal comes just before
        "preparing.save_description = wait\n"
        "from swarmtwin.commands import main\nmain()\n"
    )
    command = [sys.executable, str(hold), "prepare", "robot=mgr", f"recording={recording}", "output=out"]
    process = subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True)
    assert process.stdout.readline() == "waiting\n"
    process.send_signal(stop)
    _, error = process.communicate(timeout=20)
    assert process.returncode == 130
    assert error.strip().splitlines()[-1].startswith("swarmtwin prepare: interrupted")
    assert "Traceback" not in error
    assert not (workplace / "out").exists()
    assert call("prepare", "robot=mgr", f"recording={recording}", "output=out") == 0


@pytest.mark.parametrize("stop", [signal.SIGINT, signal.SIGTERM])
def test_an_interrupt_while_packages_are_imported_is_one_line(workplace, stop):
    """From the first line of ours on: an import may swallow the exception that Python makes of it."""
    (workplace / "hydra.py").write_text(
        "import time\ntry:\n    print('importing', flush=True)\n    for _ in range(200):\n        time.sleep(0.1)\n"
    )
    with (workplace / "hydra.py").open("a") as module:
        module.write("except BaseException:\n    raise ImportError('swallowed')\n")
    script = "import sys; sys.path.insert(0, ''); sys.argv = ['swarmtwin', 'train']\n"
    command = [sys.executable, "-c", f"{script}from swarmtwin.commands import main; main()"]
    process = subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True)
    assert process.stdout.readline() == "importing\n"
    process.send_signal(stop)
    _, error = process.communicate(timeout=10)
    assert (process.returncode, error) == (130, "swarmtwin: interrupted before anything had begun\n")


def test_a_killed_command_does_not_stand_in_the_way(recording, workplace):
    (workplace / ".out.partial").mkdir()
    (workplace / ".out.partial" / "transitions.parquet").write_text("half")
    (workplace / ".out.lock.partial").write_text("")
    assert call("prepare", "robot=mgr", f"recording={recording}", "output=out") == 0
    assert not (workplace / ".out.partial").exists()


def test_help_needs_none_of_the_heavy_packages():
    script = "import sys; sys.argv = ['swarmtwin', '--help']; from swarmtwin.commands import main; main()\n"
    script += "print(sorted({'torch', 'lightning', 'mlflow', 'hydra', 'pandas', 'numpy'} & sys.modules.keys()))"
    answer = subprocess.run([sys.executable, "-c", script], capture_output=True, text=True, check=True)
    assert answer.stdout.splitlines()[-1] == "[]"
    for name in COMMANDS:
        assert f"  {name}" in answer.stdout


def test_what_a_command_imports_is_no_garbage_and_what_it_makes_is_collected(workplace):
    script = """import gc, sys
from swarmtwin import commands
from swarmtwin.commands import doctor
doctor.run = lambda options: print("while it runs:", gc.isenabled(), gc.get_freeze_count() > 10_000) or {}
sys.argv = ["swarmtwin", "doctor"]
commands.main()
"""
    answer = subprocess.run([sys.executable, "-c", script], capture_output=True, text=True, check=True)
    assert "while it runs: True True" in answer.stdout


def test_an_unknown_command_names_the_one_meant():
    answer = subprocess.run([SWARMTWIN, "trian"], capture_output=True, text=True, check=False)
    assert answer.returncode == 2
    assert answer.stderr.startswith("swarmtwin: unknown command 'trian': did you mean 'train'?")


def test_each_experiment_is_one_configuration_and_no_study_is_without():
    configured = {path.stem for path in (config_folder() / "experiment").glob("*.yaml")}
    assert set(experiments()) == configured
    assert "dynamics" in configured
    folder = Path(str(files("swarmtwin.studies")))
    made = {f"swarmtwin.studies.{file.parent.name}.study" for file in folder.glob("*/study.py")}
    assert {study_module(name) for name in configured} == made


def test_each_command_of_the_table_is_a_module_and_none_is_forgotten():
    folder = Path(commands.__file__).parent
    aside = {"__init__", "app", "catalogue", "inputs", "option_help", "option_mistakes"}
    shared = aside | {"outside_config", "preloaded", "shell_completion", "sweep_mistakes", "sweep_table"}
    modules = {path.stem for path in folder.glob("*.py")} - shared
    assert {command.module for command in COMMANDS.values()} == modules


def primary_configs():
    for name, command in COMMANDS.items():
        if name != "experiment":
            yield name, name, f"swarmtwin.commands.{command.module}"
    for name in experiments():
        yield f"experiment-{name}", f"experiment/{name}", study_module(name)


@pytest.mark.parametrize(("config", "module"), [pytest.param(c, m, id=i) for i, c, m in primary_configs()])
def test_every_command_has_a_configuration_that_its_options_accept(config, module):
    options = importlib.import_module(module).Options
    with hydra.initialize_config_dir(str(config_folder()), version_base="1.3"):
        composed = hydra.compose(config)
    for key in [key for key in composed if OmegaConf.is_missing(composed, key)]:
        composed[key] = "given"
    fields = {field.alias or name for name, field in options.model_fields.items()}
    assert set(composed) == fields
    options.parse(OmegaConf.to_container(composed, resolve=True), config)
    paths = {field.alias or name for name, field in options.model_fields.items() if "Path" in str(field.annotation)}
    looked_at_otherwise = {
        "generators",
        "artifacts",
        "commands",
        "store",
        "judged",
    }  # made where they are missing; looked at robot by robot
    assert paths - {"output"} - looked_at_otherwise <= INPUTS.keys()


def test_a_config_folder_of_ones_own_is_found(recording, workplace):
    own = workplace / "own" / "robot"
    own.mkdir(parents=True)
    mgr = (config_folder() / "robot" / "mgr.yaml").read_text()
    (own / "mine.yaml").write_text(mgr.replace("name: mgr", "name: mine"))
    (recording / "recording.yaml").write_text(
        (recording / "recording.yaml").read_text().replace("robot: mgr", "robot: mine")
    )
    assert call("prepare", "--config-dir=own", "robot=mine", f"recording={recording}", "output=out") == 0
