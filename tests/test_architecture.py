"""The house keeps its shape: imports run downwards, and only commands and tests look inside the stand-ins."""

import ast
import graphlib
from pathlib import Path

import pytest

PACKAGE = Path(__file__).resolve().parents[1] / "src" / "swarmtwin"

GROUND = {
    "compilable",
    "compiled",
    "configuration",
    "errors",
    "extras",
    "files",
    "geometry",
    "hardware",
    "kinematics",
    "markers",
    "plain_yaml",
    "plotting",
    "plugins",
    "robot",
    "strict_model",
}
ORDER = ("recordings", "transitions", "learning", "dynamics", "simulation")
MAY_IMPORT = {
    "compilable": set(),
    "compiled": set(),
    "configuration": {"plugins"},
    "errors": set(),
    "extras": {"errors"},
    "files": {"errors"},
    "geometry": set(),
    "hardware": {"strict_model"},
    "kinematics": {"plugins", "strict_model"},
    "markers": {"errors", "hardware", "robot", "strict_model"},
    "plotting": set(),
    "plugins": {"errors"},
    "plain_yaml": {"errors", "files"},
    "robot": {"errors", "hardware", "kinematics", "plain_yaml", "plugins", "strict_model"},
    "strict_model": {"errors"},
    "recordings": GROUND,
    "transitions": GROUND | {"recordings"},
    "learning": GROUND | {"recordings", "transitions"},
    "dynamics": GROUND | {"recordings", "transitions", "learning"},
    "generators": GROUND | {"recordings", "transitions", "learning"},
    "simulation": GROUND | set(ORDER),
    "diagnosis": GROUND | set(ORDER),
    "world": GROUND | set(ORDER),
    "policies": GROUND | {*ORDER, "world"},
    "deploy": GROUND | {*ORDER, "world", "policies"},
    "standin": {"robot", "hardware", "markers", "geometry", "errors", "plugins", "strict_model"},
    "tracking": GROUND,
    "studies": GROUND | {*ORDER, "generators", "diagnosis", "world", "policies", "deploy", "standin", "tracking"},
    "commands": None,
}


def imported_modules(path):
    """The modules of swarmtwin that a file imports from."""
    for node in ast.walk(ast.parse(path.read_text())):
        if isinstance(node, ast.ImportFrom) and node.module and node.level == 0:
            modules = [node.module, *(f"{node.module}.{alias.name}" for alias in node.names)]
        elif isinstance(node, ast.Import):
            modules = [alias.name for alias in node.names]
        else:
            continue
        yield from (module for module in modules if module.startswith("swarmtwin."))


def imported_rooms(path):
    """The rooms of swarmtwin that a file imports from."""
    return {module.split(".")[1] for module in imported_modules(path)}


def room_of(path):
    return path.relative_to(PACKAGE).parts[0].removesuffix(".py")


@pytest.mark.parametrize("path", sorted(PACKAGE.rglob("*.py")), ids=lambda path: str(path.relative_to(PACKAGE)))
def test_imports_run_downwards_only(path):
    room = room_of(path)
    if room in ("__init__", "__main__"):
        return
    assert room in MAY_IMPORT, f"a new room: say in this test what {room} may import"
    allowed = MAY_IMPORT[room]
    if allowed is not None and path.is_relative_to(PACKAGE / "deploy" / "fleet"):
        allowed = allowed | {"standin"}
    rooms = set(imported_rooms(path)) - {room, "__version__"}
    assert allowed is None or rooms <= allowed


def test_no_modules_import_each_other():
    """Not in a circle either, and not for types alone: the sorter's error names the circle."""
    modules = {".".join(path.relative_to(PACKAGE.parent).with_suffix("").parts): path for path in PACKAGE.rglob("*.py")}
    modules = {name.removesuffix(".__init__"): path for name, path in modules.items()}
    imports = {name: modules.keys() & set(imported_modules(path)) - {name} for name, path in modules.items()}
    assert len(imports) > 200
    graphlib.TopologicalSorter(imports).prepare()


def test_every_room_named_here_exists():
    assert set(MAY_IMPORT) <= {room_of(path) for path in PACKAGE.rglob("*.py")}


def test_only_the_fleet_studies_commands_and_tests_know_the_stand_ins():
    knowing = {path for path in PACKAGE.rglob("*.py") if "standin" in set(imported_rooms(path))}
    fleet = set((PACKAGE / "deploy" / "fleet").rglob("*.py"))
    assert {room_of(path) for path in knowing - fleet} <= {"commands", "studies", "standin"}


def test_only_evaluation_and_those_who_record_stand_ins_read_what_they_would_do_on_average():
    """The exact means tell what nobody can measure: nothing that learns, simulates or diagnoses may see them."""
    reading = {
        room_of(path) if room_of(path) in ("commands", "studies") else str(path.relative_to(PACKAGE))
        for path in PACKAGE.rglob("*.py")
        if "swarmtwin.recordings.exact_means" in set(imported_modules(path))
    }
    assert reading <= {"simulation/evaluation.py", "simulation/best_prediction.py", "commands", "studies"}
    diagnosing = ("diagnosis", "commands/diagnose.py", "simulation/mechanism", "studies/hidden_effects")
    knowing = {"swarmtwin.recordings.exact_means", "swarmtwin.simulation.best_prediction"}
    for path in PACKAGE.rglob("*.py"):
        if str(path.relative_to(PACKAGE)).startswith(diagnosing):
            assert not knowing & set(imported_modules(path)), path


def test_no_room_is_nameless():
    assert not [path for path in PACKAGE.rglob("*.py") if path.stem in {"utils", "util", "helpers", "misc", "common"}]
