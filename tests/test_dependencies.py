"""What the package imports is what it declares, in ranges that leave room for others."""

import ast
import re
import sys
import tomllib
from collections import ChainMap
from functools import cache
from importlib.metadata import packages_distributions
from pathlib import Path

import pytest
from packaging.requirements import Requirement

from swarmtwin.commands.catalogue import COMMANDS

REPOSITORY = Path(__file__).resolve().parents[1]
LOADED_BY_OTHERS = {
    "hydra-joblib-launcher": "Hydra, for sweeps",
    "hydra-submitit-launcher": "Hydra, for sweeps by Slurm",
    "psycopg": "SQLAlchemy, for PostgreSQL",
    "aiobotocore": "DVC, for buckets, and its boto3 MLflow",
    "dvc-s3": "DVC, for buckets",
    "psutil": "MLflow, for how busy the machine is",
    "mujoco": "rigid bodies, which look for it by its name",
}
PROJECT = tomllib.loads((REPOSITORY / "pyproject.toml").read_text())["project"]
EXTRAS = {"base": PROJECT["dependencies"], **PROJECT["optional-dependencies"]}
SOURCES = sorted((REPOSITORY / "src").rglob("*.py"))
COMPUTING = ("deploy", "tracking", "train", "studies")
BY_NAME = ("slurm", "ray", "postgresql", "s3")
NEVER_ON_A_ROBOTS_COMPUTER = {
    "lightning",
    "mlflow",
    "dvc",
    "optuna",
    "stable-baselines3",
    "numba",
    "scikit-learn",
    "onnx",
}


def stated(extra):
    """What an extra asks for by itself, by the distribution's normal name."""
    return {normal(Requirement(text).name): Requirement(text) for text in EXTRAS[extra]}


def asked_for(extra):
    """What an extra and those that it is made of ask for, beside the package's own requirements."""
    own = stated(extra)
    parts = own.pop("swarmtwin").extras if "swarmtwin" in own else ()
    return dict(ChainMap(own, *map(asked_for, sorted(parts))))


def declared():
    """The requirements of the package itself and of the extras that it computes with."""
    return dict(ChainMap(*map(asked_for, ("base", *COMPUTING, *BY_NAME))))


def normal(name):
    return re.sub(r"[-_.]+", "-", name).lower()


@cache
def parsed(file):
    return ast.parse(file.read_text())


def at_start(node):
    """The parts of a module that are run when it is imported: no functions, and nothing for type checkers alone."""
    for child in ast.iter_child_nodes(node):
        checked = isinstance(child, ast.If) and "TYPE_CHECKING" in ast.unparse(child.test)
        if not checked and not isinstance(child, ast.FunctionDef | ast.AsyncFunctionDef | ast.Lambda):
            yield child
            yield from at_start(child)


def names_in(file, parts):
    """The modules that a file names in the imports among some of its parts, and what it takes from them."""
    for node in parts(parsed(file)):
        if isinstance(node, ast.Import):
            yield from (alias.name for alias in node.names)
        if isinstance(node, ast.ImportFrom) and node.module:
            yield from (node.module, *(f"{node.module}.{alias.name}" for alias in node.names))


def imported(files, parts=ast.walk):
    """The distributions that modules import, anywhere or in some of their parts."""
    distributions, found = packages_distributions(), {}
    for file in files:
        packages = {name.partition(".")[0] for name in names_in(file, parts)}
        for name in packages - sys.stdlib_module_names - {"swarmtwin"}:
            found.setdefault(frozenset(map(normal, distributions.get(name, [name]))), file)
    return found


def loaded_with(module):
    """The files of all modules of the package that are imported with one, at its start."""
    own = {".".join(file.relative_to(REPOSITORY / "src").with_suffix("").parts): file for file in SOURCES}
    own = {name.removesuffix(".__init__"): file for name, file in own.items()}
    waiting, loaded = [module], set()
    while waiting:
        name = waiting.pop()
        if name in own and name not in loaded:
            loaded.add(name)
            waiting += [name.rpartition(".")[0], *names_in(own[name], at_start)]
    return [own[name] for name in loaded]


def test_what_is_imported_is_declared_and_what_is_declared_is_used():
    undeclared = {names: file for names, file in imported(SOURCES).items() if not names & declared().keys()}
    assert not undeclared
    unused = declared().keys() - set().union(*imported(SOURCES)) - LOADED_BY_OTHERS.keys()
    assert not unused


@pytest.mark.parametrize("name", COMMANDS)
def test_a_command_imports_nothing_but_what_its_extra_brings(name):
    """At its start, and with whatever it then imports; what a function imports is for those who call it."""
    command = COMMANDS[name]
    brought = asked_for("base").keys() | asked_for(command.extra).keys()
    files = loaded_with(f"swarmtwin.commands.{command.module}") + loaded_with("swarmtwin.commands.app")
    assert len(files) > 10
    not_brought = {names: file for names, file in imported(files, at_start).items() if not names & brought}
    assert not not_brought


def test_a_robots_computer_needs_nothing_that_trains():
    assert not NEVER_ON_A_ROBOTS_COMPUTER & (asked_for("base").keys() | asked_for("deploy").keys())


def test_only_torch_is_one_version_and_what_is_tested_is_in_every_range():
    pinned = dict(line.split("==") for line in (REPOSITORY / "constraints.txt").read_text().split() if "==" in line)
    tested = {normal(name): version for name, version in pinned.items()}
    for name, requirement in asked_for("dev").items() | asked_for("base").items():
        assert requirement.specifier.contains(tested[name]), requirement
        exact = {one.operator for one in requirement.specifier} == {"=="}
        assert exact == (name == "torch"), requirement
