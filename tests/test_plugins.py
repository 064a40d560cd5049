"""The registries of plug-ins: they find what lies on the disk, in and outside the package, and nothing else."""

import ast
import importlib
import sys
from pathlib import Path
from types import ModuleType

import pytest
import yaml

from swarmtwin.configuration import config_files, config_folders
from swarmtwin.errors import UserError
from swarmtwin.plugins import PluginRegistry, plugin_folders, plugin_path
from swarmtwin.tracking.pipeline import Code

SOURCE = Path(__file__).resolve().parents[1] / "src"
CODE = Code(SOURCE)
KINDS = [(module, kind) for module, kinds in CODE.plugin_kinds.items() for kind in kinds]
every_kind = pytest.mark.parametrize(("module", "kind"), KINDS, ids=[kind.package for _, kind in KINDS])


def registry_of(module, kind):
    """The registry itself, as its module makes it."""
    found = [
        value
        for value in vars(importlib.import_module(module)).values()
        if isinstance(value, PluginRegistry) and value.package.__name__ == kind.package
    ]
    assert len(found) == 1
    return found[0]


def test_every_plugin_package_has_one_registry_and_every_registry_a_plugin_package():
    setting_their_path = {
        ".".join(file.parent.relative_to(SOURCE).parts)
        for file in (SOURCE / "swarmtwin").rglob("__init__.py")
        if "__path__ = plugin_path(__name__, __path__)" in file.read_text()
    }
    assert sorted(kind.package for _, kind in KINDS) == sorted(setting_their_path)


@every_kind
def test_a_registry_knows_every_file_and_every_file_ends_in_its_class(module, kind):
    registry = registry_of(module, kind)
    folder = SOURCE.joinpath(*kind.package.split("."))
    assert set(registry.names()) == {file.stem for file in folder.glob("*.py")} - {"__init__"}
    for name in registry.names():
        classes = [
            node for node in ast.parse((folder / f"{name}.py").read_text()).body if isinstance(node, ast.ClassDef)
        ]
        assert classes[-1].name == registry.ends_in
        assert registry.plugin_class(name).__module__ == f"{kind.package}.{name}"


@every_kind
def test_every_plugin_is_chosen_by_a_file_of_its_group_and_every_file_chooses_one(module, kind):
    registry = registry_of(module, kind)
    if registry.group is None:
        return
    chosen = {yaml.safe_load(file.read_text())[registry.field] for file in config_files(registry.group).values()}
    without_stand_in = {"create", "car"} if kind.package == "swarmtwin.standin.robots" else set()
    assert chosen == set(registry.names()) | without_stand_in


@pytest.fixture
def shapes(tmp_path, monkeypatch):
    """A plug-in package `rooms.shapes` with a round and a square one, and its registry."""
    package = tmp_path / "own" / "shapes"
    package.mkdir(parents=True)
    for name in ("round", "square"):
        (package / f"{name}.py").write_text(
            "class Config:\n    @classmethod\n    def parse(cls, content, where):\n        return content\n"
        )
    (tmp_path / "mine" / "shapes").mkdir(parents=True)
    monkeypatch.setenv("SWARMTWIN_PLUGINS", str(tmp_path / "mine"))
    module = ModuleType("rooms.shapes")
    module.__path__ = plugin_path("rooms.shapes", [str(package)])
    monkeypatch.setitem(sys.modules, "rooms.shapes", module)
    return PluginRegistry(module, "shape", group="shape")


def test_a_plugin_outside_the_package_is_found_beside_those_in_it(shapes, tmp_path):
    (tmp_path / "mine" / "shapes" / "star.py").write_text("class Config:\n    points = 5\n")
    assert shapes.names() == ("round", "square", "star")
    assert shapes.plugin_class("star").points == 5
    assert shapes.plugin_class("star").__module__ == "rooms.shapes.star"


def test_a_configuration_becomes_what_its_plugin_makes_of_it(shapes):
    assert shapes.config({"name": "round", "size": 3}, "x") == {"name": "round", "size": 3}


@pytest.mark.parametrize(
    ("content", "message"),
    [
        ({}, "x: field 'name' is missing: it says which shape; known: round, square"),
        (None, "x: field 'name' is missing: it says which shape; known: round, square"),
        ({"name": "rounb"}, "no such shape: 'rounb': did you mean 'round'? known: round, square"),
        ({"name": "../round"}, "no such shape: '../round': did you mean 'round'? known: round, square"),
    ],
)
def test_an_unknown_plugin_names_the_one_meant(shapes, content, message):
    with pytest.raises(UserError) as error:
        shapes.config(content, "x")
    assert str(error.value) == message


def test_two_plugins_of_one_name_are_refused(shapes, tmp_path):
    (tmp_path / "mine" / "shapes" / "round.py").touch()
    with pytest.raises(UserError) as error:
        shapes.names()
    mine, own = tmp_path / "mine" / "shapes", tmp_path / "own" / "shapes"
    assert str(error.value) == f"there are two shapes 'round', in {own} and {mine}: rename one of them"


def test_a_file_that_ends_in_something_else_says_what_it_lacks(shapes, tmp_path):
    file = tmp_path / "mine" / "shapes" / "line.py"
    file.write_text("class Line:\n    pass\n")
    with pytest.raises(UserError) as error:
        shapes.plugin_class("line")
    assert str(error.value) == f"{file}: no class 'Config': every shape's file ends in one"


def test_a_folder_of_plugins_that_is_not_there_is_refused(monkeypatch, tmp_path):
    monkeypatch.setenv("SWARMTWIN_PLUGINS", str(tmp_path / "nowhere"))
    with pytest.raises(
        UserError, match=r"^SWARMTWIN_PLUGINS names .*nowhere, which is no folder: correct it, or unset"
    ):
        plugin_folders()


def test_configurations_beside_plugins_are_found_as_well(monkeypatch, tmp_path):
    for name in ("one", "two"):
        (tmp_path / name / "conf" / "robot").mkdir(parents=True)
        (tmp_path / name / "conf" / "robot" / f"{name}.yaml").touch()
    monkeypatch.setenv("SWARMTWIN_PLUGINS", f"{tmp_path / 'one'}:{tmp_path / 'two'}")
    assert config_folders()[1:] == (tmp_path / "one" / "conf", tmp_path / "two" / "conf")
    assert {"mgr", "mur", "create", "car", "one", "two"} == set(config_files("robot"))
