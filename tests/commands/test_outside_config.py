"""Configurations from outside are data: they choose no code, and none of them hangs or breaks a command."""

import os
import pickle
import time
from pathlib import Path

import numpy as np
import pytest

from swarmtwin.commands.app import run_command
from swarmtwin.configuration import config_folder
from swarmtwin.errors import UserError
from swarmtwin.plain_yaml import Bounds, read_yaml

ROBOT = (config_folder() / "robot" / "mgr.yaml").read_text().replace("name: mgr", "name: mine")
CALLBACK = """hydra:
  callbacks:
    mine:
      _target_: pandas.read_pickle
      filepath_or_buffer: code.pickle
"""


class Code:
    def __reduce__(self):
        return Path.touch, (Path("ran"),)


@pytest.fixture
def own(workplace):
    """A folder of one's own beside a pickle that leaves `ran` when it is opened."""
    (workplace / "own" / "robot").mkdir(parents=True)
    (workplace / "code.pickle").write_bytes(pickle.dumps(Code()))
    return workplace / "own" / "robot" / "mine.yaml"


@pytest.mark.parametrize(
    ("text", "message"),
    [
        (f"# @package _global_\n{CALLBACK}{ROBOT}", "'# @package' moves it to another place"),
        (ROBOT + CALLBACK, "'hydra' would choose code or settings of Hydra's"),
        (ROBOT + "note: {_target_: os.system}\n", "'_target_' would choose code"),
        ("defaults:\n  - override /hydra/launcher: joblib\n" + ROBOT, "would choose settings of Hydra's: take it out"),
        (ROBOT + "note: ${oc.env:HOME}\n", "'${oc.env:HOME}' refers to what is not in the file: write the value out"),
        (ROBOT + "note: " + "[" * 3000 + "\n", "more than 50 lists or mappings in each other"),
        (ROBOT + "note: [unclosed\n", "is not valid YAML"),
        (ROBOT + "defaults: mgr\n", "'defaults' is no list"),
        (ROBOT + "defaults: [1, x]\n", "'defaults' is no list of other files' names: take it out"),
        (ROBOT + "defaults: [{}]\n", "'defaults' is no list of other files' names"),
        (ROBOT + "defaults: [{a: [1]}]\n", "'defaults' is no list of other files' names"),
        (ROBOT + "period_s: 0.4\n", "is not valid YAML ('period_s' stands twice"),
    ],
    ids=[
        *("package", "hydra", "target", "defaults", "interpolation", "depth", "damage", "no list"),
        *("a number", "no group", "no choice", "twice"),
    ],
)
def test_a_robot_from_outside_chooses_nothing_but_a_robot(own, workplace, capfd, text, message):
    own.write_text(text)
    started = time.monotonic()
    assert run_command("prepare", ["--config-dir=own", "robot=mine", "recording=nowhere", "output=out"]) == 2
    assert time.monotonic() - started < 10
    error = capfd.readouterr().err
    assert error.startswith("swarmtwin prepare: own/robot/mine.yaml")
    assert message in error
    assert error.count("\n") == 1
    assert not (workplace / "ran").exists()
    assert not (workplace / "out").exists()


@pytest.mark.parametrize("named", ["hydra.searchpath=[file://{}]", "hydra.searchpath=['pkg://mine','{}']"])
def test_a_folder_in_hydras_search_path_is_read_as_data_too(own, workplace, capfd, named):
    folder = own.parents[1]
    own.write_text(ROBOT)
    options = [named.format(folder), "robot=mine", "recording=nowhere", "output=out"]
    assert run_command("prepare", options) == 2
    assert "nowhere" in capfd.readouterr().err  # the robot was found
    own.write_text(ROBOT + "note: {_target_: os.system}\n")
    assert run_command("prepare", options) == 2
    assert "'_target_' would choose code" in capfd.readouterr().err


def test_the_pickle_would_have_run(own, workplace):
    """Else the tests above showed nothing."""
    np.load("code.pickle", allow_pickle=True)
    assert (workplace / "ran").exists()


@pytest.mark.parametrize("option", [("--config-dir", "own"), ("-cd", "own"), ("-cd=own",)])
def test_however_the_folder_is_named(own, capfd, option):
    own.write_text(ROBOT + CALLBACK)
    assert run_command("prepare", [*option, "robot=mine", "recording=nowhere", "output=out"]) == 2
    assert "would choose code" in capfd.readouterr().err


def test_a_robot_that_is_one_is_taken(own, capfd):
    own.write_text(ROBOT)
    assert run_command("prepare", ["--config-dir=own", "robot=mine", "recording=nowhere", "output=out"]) == 2
    assert "no recording folder nowhere" in capfd.readouterr().err


def bomb(levels=12):
    lines = ["a0: &a0 [x, x, x, x, x, x, x, x, x]"]
    lines += [f"a{i}: &a{i} [{', '.join([f'*a{i - 1}'] * 9)}]" for i in range(1, levels)]
    return "\n".join(lines)


def test_aliases_that_multiply_are_refused_at_once(tmp_path):
    file = tmp_path / "bomb.yaml"
    file.write_text(bomb())
    started = time.monotonic()
    with pytest.raises(UserError, match="more than 1000000 values, aliases included"):
        read_yaml(file)
    assert time.monotonic() - started < 1


def test_aliases_that_do_not_are_read(tmp_path):
    file = tmp_path / "few.yaml"
    file.write_text("one: &one [1, 2]\nother: [*one, *one]\n")
    assert read_yaml(file) == {"one": [1, 2], "other": [[1, 2], [1, 2]]}


def test_a_file_that_is_none_does_not_block(tmp_path):
    os.mkfifo(tmp_path / "pipe.yaml")
    with pytest.raises(UserError, match=r"pipe\.yaml is no regular file"):
        read_yaml(tmp_path / "pipe.yaml")


def test_a_huge_file_is_not_read(tmp_path):
    (tmp_path / "huge.yaml").write_text("x" * 2000)
    with pytest.raises(UserError, match="holds 2000 bytes, more than 1000"):
        read_yaml(tmp_path / "huge.yaml", Bounds(size=1000))
