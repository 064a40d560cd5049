"""What the package imports is what it declares, in ranges that leave room for others."""

import ast
import re
import sys
import tomllib
from importlib.metadata import packages_distributions
from pathlib import Path

from packaging.requirements import Requirement

REPOSITORY = Path(__file__).resolve().parents[1]
LOADED_BY_OTHERS = {"hydra-joblib-launcher": "Hydra, for sweeps", "onnxscript": "torch.onnx, to export"}


def declared():
    """The requirements of the package itself, by the distribution's normal name."""
    texts = tomllib.loads((REPOSITORY / "pyproject.toml").read_text())["project"]["dependencies"]
    return {normal(Requirement(text).name): Requirement(text) for text in texts}


def normal(name):
    return re.sub(r"[-_.]+", "-", name).lower()


def imported():
    """The distributions that modules of the package import, wherever in a module they do."""
    distributions, found = packages_distributions(), {}
    for file in (REPOSITORY / "src").rglob("*.py"):
        for node in ast.walk(ast.parse(file.read_text())):
            names = [alias.name for alias in node.names] if isinstance(node, ast.Import) else []
            if isinstance(node, ast.ImportFrom) and node.module:
                names = [node.module]
            for name in {name.partition(".")[0] for name in names} - sys.stdlib_module_names - {"swarmtwin"}:
                found.setdefault(frozenset(map(normal, distributions[name])), file)
    return found


def test_what_is_imported_is_declared_and_what_is_declared_is_used():
    undeclared = {names: file for names, file in imported().items() if not names & declared().keys()}
    assert not undeclared
    unused = declared().keys() - set().union(*imported()) - LOADED_BY_OTHERS.keys()
    assert not unused


def test_only_torch_is_one_version_and_what_is_tested_is_in_every_range():
    pinned = dict(line.split("==") for line in (REPOSITORY / "constraints.txt").read_text().split() if "==" in line)
    tested = {normal(name): version for name, version in pinned.items()}
    for name, requirement in declared().items():
        assert requirement.specifier.contains(tested[name]), requirement
        exact = {one.operator for one in requirement.specifier} == {"=="}
        assert exact == (name == "torch"), requirement
