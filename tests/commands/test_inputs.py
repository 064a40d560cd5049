"""What a command is to read is looked at first: what is missing or of another kind is said before torch is imported."""

import json
import os
import subprocess
import sys

import pytest

from swarmtwin.commands.app import run_command

HEAVY = {"torch", "lightning", "mlflow", "pandas", "scipy", "matplotlib"}
A_RECORDING = "robot: mgr\nperiod_s: 0.5\narena_mm: {x: [0, 1030], y: [0, 1030]}\nsource: a test\n"
MISTAKES = [
    ("record drive=none output=o", "drive none is missing: name a CSV file with left, right"),
    ("import path=none output=o", "there is nothing at path=none"),
    ("prepare recording=none output=o", "no recording folder none"),
    ("prepare recording=without_runs output=o", "without_runs/runs is missing"),
    ("prepare recording=good output=o robot=mur", "the recording is of robot 'mgr', not of 'mur'"),
    ("generate", "say of which robot: robot=..., or give a generator's folder: from=..."),
    ("generate from=empty", "no generator in empty: generator.yaml is missing; name a folder that generate made"),
    ("train", "no transitions in artifacts/transitions/mgr: run `dvc repro` first, or give"),
    ("train transitions=good", "good/preparation.json is missing: name a folder that swarmtwin prepare made"),
    ("train transitions=good recording=good", "give transitions=... or recording=..., not both"),
    ("train recording=good vehicles=[]", "field 'vehicles': Tuple should have at least 1"),
    ("train recording=good robot.period_s=-1", "field 'robot.period_s': Input should be greater than 0"),
    ("evaluate simulation=none recording=good output=o", "no model folder none: give a folder, models:/NAME@ALIAS"),
    ("evaluate simulation=model recording=good output=o", "model is a model of robot 'mur': add robot=mur"),
    ("evaluate simulation=pipe recording=good output=o", "pipe/model.yaml is no regular file"),
    ("evaluate simulation=models:/x recording=good output=o", "'models:/x' names no model: write models:/NAME@ALIAS"),
    ("tune recording=none", "no recording folder none"),
    ("diagnose measured=good", "give reference=DIR, a recording in which nothing is wrong, or simulation="),
    ("diagnose measured=none reference=good", "no recording folder none"),
    ("diagnose measured=good reference=[good,none]", "no recording folder none"),
    ("learn", "no simulation in artifacts/dynamics/mgr/crnet_synthetic: run `dvc repro` first"),
    ("rollout policy=empty output=o", "no policy in empty: policy.yaml is missing; name a folder that learn made"),
    ("promote recording=none", "no recording folder none"),
    ("promote what=policy candidate=models:x", "'models:x' names no model"),
    ("experiment name=dynamics output=o", "no folder artifacts/dynamics/mgr with models: run `dvc repro` first"),
    ("experiment name=transfer policies=empty output=o", "empty holds no policy of robot 'mgr'"),
    ("experiment name=table5 output=o", "no simulation in artifacts/dynamics/mgr/fcnn: run `dvc repro` first, or give"),
    ("experiment name=table6 simulations.FC-NN=model output=o", "model is a model of robot 'mur': add robot=mur"),
    ("experiment name=overview", "artifacts/comparison/mgr holds no comparison of models: run `dvc repro` first"),
    ("experiment name=pictures folder=empty output=o", "empty holds no output of swarmtwin"),
    ("train -m robot=nosuch model=mlp,gru", "no such robot: 'nosuch'"),
    ("train -m robot=mgr,mur model=mlp,nosuch", "no such model: 'nosuch'"),
    ("train -m model=mlp,gru model.nosuch=1", "unknown option 'model.nosuch'"),
    ("train -m seed=1,2 recording=none", "no recording folder none"),
    ("learn -m policy=ddpg,td3 'seed=range(1,500)'", "no simulation in artifacts/dynamics/mgr/crnet_synthetic"),
    ("prepare -m recording=none,neither output=o", "no recording folder none"),
    ("experiment name=hidden_effects robots=[mrg] output=o", "robots: no such robot: 'mrg': did you mean 'mgr'?"),
]


@pytest.fixture
def folders(workplace):
    """A recording that is whole, one without runs, a model of another robot and an empty folder."""
    for name in ("good/runs", "without_runs", "empty", "model", "pipe"):
        (workplace / name).mkdir(parents=True)
    for name in ("good", "without_runs"):
        (workplace / name / "recording.yaml").write_text(A_RECORDING)
    (workplace / "good" / "runs" / "one.csv").write_text("time_s,vehicle,left,right,x_mm,y_mm,heading_rad\n")
    (workplace / "model" / "model.yaml").write_text("format: 1\nrobot:\n  title: A robot\n  name: mur\nsituation: []\n")
    os.mkfifo(workplace / "pipe" / "model.yaml")
    return workplace


def test_missing_inputs_are_answered_before_anything_that_computes_is_imported(folders):
    script = "import json, shlex, sys; from swarmtwin.commands.app import run_command\n"
    script += "for line in json.load(sys.stdin):\n"
    script += "    name, *options = shlex.split(line)\n"
    script += "    status = run_command(name, options)\n"
    script += f"    print(int(status), sorted({HEAVY!r} & sys.modules.keys()), flush=True)"
    commands = [command for command, _ in MISTAKES]
    answer = subprocess.run(
        [sys.executable, "-c", script], input=json.dumps(commands), capture_output=True, text=True, check=True
    )
    for (command, message), shown, error in zip(
        MISTAKES, answer.stdout.splitlines(), answer.stderr.splitlines(), strict=True
    ):
        status, heavy = shown.split(maxsplit=1)
        assert message in error, command
        assert (status, heavy) == ("2", "[]"), command
    assert {path.name for path in folders.iterdir()} == {"good", "without_runs", "empty", "model", "pipe"}


def test_a_sweep_of_which_a_run_has_what_it_reads_goes_on(folders, capfd):
    assert run_command("prepare", ["-m", "recording=none,good,neither", "output=o"]) != 0
    errors = capfd.readouterr()
    assert "no recording folder none" in errors.out + errors.err
    assert "3" in errors.out
    assert "no recording folder neither" in errors.out


def test_what_a_command_will_not_read_need_not_be_there(workplace, capfd):
    """The store is new, too, and rolling back is the first that this process does with it: it waited for itself."""
    run_command("promote", ["rollback=true", "recording=none", "candidate=none"])
    run_command("promote", ["what=policy", "recording=none"])
    demoted, refused = capfd.readouterr().err.strip().splitlines()[-2:]
    assert "mgr-dynamics has no champion to roll back from" in demoted
    assert "no registered model 'mgr-policy'" in refused
