"""The house keeps its shape: imports run downwards, and only commands and tests look inside the stand-ins."""

import ast
from pathlib import Path

import pytest

PACKAGE = Path(__file__).resolve().parents[1] / "src" / "swarmtwin"

FOUNDATION = {"configuration", "errors", "files", "geometry", "kinds", "plotting", "robot"}
MAY_IMPORT = {
    "configuration": set(),
    "errors": set(),
    "files": {"errors"},
    "geometry": set(),
    "kinds": {"errors", "robot"},
    "plotting": set(),
    "robot": {"errors"},
    "recordings": FOUNDATION,
    "transitions": FOUNDATION | {"recordings"},
    "trainer": set(),
    "weights": {"errors", "files"},
    "dynamics": FOUNDATION | {"recordings", "transitions", "processes", "trainer", "weights"},
    "generators": FOUNDATION | {"transitions", "trainer", "weights"},
    "processes": {"errors"},
    "world": FOUNDATION | {"recordings", "transitions", "dynamics"},
    "policies": FOUNDATION | {"gap", "dynamics", "world", "trainer", "weights", "processes"},
    "gap": FOUNDATION | {"recordings", "transitions", "dynamics", "weights"},
    "gate": {"errors", "geometry"},
    "standin": {"robot", "geometry", "errors"},
    "tracking": FOUNDATION,
    "registry": FOUNDATION | {"tracking"},
    "commands": None,
}


def imported_rooms(path):
    """The rooms of swarmtwin that a file imports from."""
    for node in ast.walk(ast.parse(path.read_text())):
        if isinstance(node, ast.ImportFrom) and node.module and node.level == 0:
            modules = (
                [node.module] if node.module != "swarmtwin" else [f"swarmtwin.{alias.name}" for alias in node.names]
            )
        elif isinstance(node, ast.Import):
            modules = [alias.name for alias in node.names]
        else:
            continue
        yield from (module.split(".")[1] for module in modules if module.startswith("swarmtwin."))


def room_of(path):
    return path.relative_to(PACKAGE).parts[0].removesuffix(".py")


@pytest.mark.parametrize("path", sorted(PACKAGE.rglob("*.py")), ids=lambda path: str(path.relative_to(PACKAGE)))
def test_imports_run_downwards_only(path):
    room = room_of(path)
    if room == "__init__":
        return
    assert room in MAY_IMPORT, f"a new room: say in this test what {room} may import"
    allowed = MAY_IMPORT[room]
    rooms = set(imported_rooms(path)) - {room, "__version__"}
    assert allowed is None or rooms <= allowed


def test_every_room_named_here_exists():
    assert set(MAY_IMPORT) <= {room_of(path) for path in PACKAGE.rglob("*.py")}


def test_only_commands_and_tests_know_the_stand_ins():
    knowing = {room_of(path) for path in PACKAGE.rglob("*.py") if "standin" in set(imported_rooms(path))}
    assert knowing <= {"commands", "standin"}


def test_no_room_is_nameless():
    assert not [path for path in PACKAGE.rglob("*.py") if path.stem in {"utils", "util", "helpers", "misc", "common"}]
