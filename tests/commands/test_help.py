"""`--help` and mistakes in options are answered at once, and every option of a command is explained."""

import io
import json
import subprocess
import sys

import hydra
import pytest
from omegaconf import OmegaConf
from rich.console import Console

from swarmtwin.commands.app import run_command
from swarmtwin.commands.catalogue import COMMANDS
from swarmtwin.commands.experiment import experiments
from swarmtwin.commands.option_help import ConfigFile, show_help
from swarmtwin.configuration import config_files, config_folder

NAMES = [*(name for name in COMMANDS if name != "experiment"), *(f"experiment/{study}" for study in experiments())]
HEAVY = {"torch", "lightning", "mlflow", "pandas", "scipy", "matplotlib"}


@pytest.mark.parametrize("name", NAMES)
def test_every_option_of_a_command_has_a_sentence(name):
    config = ConfigFile.read(config_folder() / f"{name}.yaml")
    assert config.summary
    silent = [one.name for one in config.options if not one.sentence and one.name != "name"]
    assert not [path for path in silent if not path.rpartition(".")[0]], silent


@pytest.mark.parametrize(
    "group", ["model", "recipe", "trainer", "split", "policy", "generator", "robot", "task", "training_grid"]
)
def test_every_field_of_a_choice_has_a_sentence(group):
    for file in config_files(group).values():
        fields = [one for one in ConfigFile.read(file).options if "." not in one.name and one.name != "name"]
        assert not [one.name for one in fields if not one.sentence], file


@pytest.mark.parametrize("name", NAMES)
def test_help_names_all_that_hydra_composes(name):
    with hydra.initialize_config_dir(str(config_folder()), version_base="1.3"):
        config = OmegaConf.to_container(hydra.compose(name))
    shown = io.StringIO()
    show_help(name.replace("/", " name="), name, [], Console(file=shown, width=200, markup=False))
    for key in config:
        assert f"  {key}" in shown.getvalue(), key


def test_help_shows_the_fields_of_what_is_chosen(capfd):
    assert run_command("train", ["model=gru", "--help"]) == 0
    shown = capfd.readouterr().out
    assert "model=gru: " in shown
    assert "model.hidden=" in shown
    assert "model.dropout" not in shown


ANSWERED_AT_ONCE = [
    (("train", "--help"), None),
    (("experiment", "name=transfer", "--help"), None),
    (("train", "robot=mrg"), "no such robot: 'mrg': did you mean 'mgr'?"),
    (("train", "epochs=3"), "unknown option 'epochs': did you mean 'recipe.epochs'?"),
    (("train", "model.epochs=3"), "unknown option 'model.epochs': did you mean 'recipe.epochs'?"),
    (("learn", "sed=3"), "unknown option 'sed': did you mean 'seed'?"),
]


def test_what_needs_no_computing_imports_nothing_that_computes():
    script = "import json, sys; from swarmtwin.commands.app import run_command\n"
    script += "for name, *options in json.load(sys.stdin):\n    run_command(name, options)\n"
    script += f"    print('heavy:', sorted({HEAVY!r} & sys.modules.keys()))"
    calls = json.dumps([arguments for arguments, _ in ANSWERED_AT_ONCE])
    answer = subprocess.run([sys.executable, "-c", script], input=calls, capture_output=True, text=True, check=True)
    heavy = [line for line in answer.stdout.splitlines() if line.startswith("heavy: ")]
    assert heavy == ["heavy: []"] * len(ANSWERED_AT_ONCE)
    messages = [message for _, message in ANSWERED_AT_ONCE if message]
    for message, error in zip(messages, answer.stderr.splitlines(), strict=True):
        assert message in error
