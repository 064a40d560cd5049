"""A campaign of damaged configurations, recordings and model folders: each is refused in one line, or used.

`python tests/campaigns/fuzz.py --count 10000 --seed 1 --state outputs/fuzz.jsonl` goes on where it was broken off. A
case fails that ends in anything but a result or a `UserError`, lasts longer than ten seconds, runs code, changes its
input, or leaves an output although it was refused.
"""

import argparse
import collections
import contextlib
import hashlib
import io
import itertools
import json
import os
import random
import shutil
import signal
import tempfile
import traceback
from pathlib import Path
from typing import Any, NamedTuple

import yaml

from swarmtwin.commands.app import run_command
from swarmtwin.configuration import config_folder
from swarmtwin.errors import UserError
from swarmtwin.recordings.reading import read_recording
from swarmtwin.robot import Robot
from swarmtwin.simulation.evaluation import load_simulation
from swarmtwin.standin.physics import Physics
from swarmtwin.transitions import from_recording

KINDS = ("configuration", "recording", "model")
LONGEST_S = 10
CODE = "!!python/object/apply:os.system ['touch ran']"
VALUES: tuple[Any, ...] = (
    *(None, True, "", "x", "mgr", "../../x", "/dev/zero", "\0", "é" * 50, "${oc.env:HOME}", "_target_", "@package"),
    *(0, -1, 1, 1e-300, 1e300, -1e300, float("nan"), float("inf"), 10**400, 2**63, "1e400", "0x10", "2024-01-01"),
    *([], {}, [[]], {"a": {"b": []}}, ["command", "command"], {"_target_": "os.system"}, ["x"] * 1000, [1, "x", None]),
)
WORDS = (
    *(b"# @package _global_\n", b"_target_: os.system\n", b"hydra: {run: {dir: ran}}\n", CODE.encode(), b"&a [*a]"),
    *(b"[" * 3000, b"{" * 3000, b"\t", b"\xff\xfe", b"\0", b": : :", b"- - -", b"'", b"%YAML 9.9\n", b"!!binary x"),
)


class Case(NamedTuple):
    """One damaged folder: which, of what kind, and how it ended."""

    number: int
    kind: str
    outcome: str
    damage: str


class Hang(BaseException):
    """A case that lasts too long; not an `Exception`, which code under test may catch."""


def sound_folders(place: Path) -> dict[str, Path]:
    """Make what is to be damaged: a robot's file, a recording, a model."""
    Physics.bank_rows = 2048
    os.environ.pop("MLFLOW_TRACKING_URI", None)  # MLflow sets it to the last store
    robot = place / "configuration"
    (robot / "robot").mkdir(parents=True)
    mgr = (config_folder() / "robot" / "mgr.yaml").read_text()
    (robot / "robot" / "mine.yaml").write_text(mgr.replace("name: mgr", "name: mine"))
    with contextlib.chdir(place), contextlib.redirect_stdout(io.StringIO()), contextlib.redirect_stderr(io.StringIO()):
        drive = ("robot=mgr", "runs=12", "steps=12", "seed=1")
        assert run_command("record", [*drive, "output=recording"]) == 0
        (place / "recording" / "truth.parquet").unlink()
        learning = ("model=kinematic", "model.steps=3", "seeds=1", "register=false", "pictures=false")
        assert run_command("train", ["robot=mgr", "recording=recording", *learning, "output=model"]) == 0
        shutil.copytree("recording", "of_mine")
        header = place / "of_mine" / "recording.yaml"
        header.write_text(header.read_text().replace("robot: mgr", "robot: mine"))
    return {kind: place / kind for kind in KINDS}


def damage_file(rng: random.Random, file: Path) -> str:
    """Damage one file: its structure where it is YAML, its bytes anywhere; return how."""
    content = file.read_bytes()
    if file.suffix == ".yaml" and rng.random() < 0.6:
        data = yaml.safe_load(content)
        place, key = rng.choice([(node, key) for node in _nodes(data) for key in _keys(node)])
        action = rng.choice(("replace", "replace", "remove", "add", "rename"))
        value = rng.choice(VALUES)
        if action == "replace":
            place[key] = value
        elif isinstance(place, dict) and action == "add":
            place[rng.choice(("_target_", "hydra", "defaults", "x", "name", 1, None))] = value
        elif isinstance(place, dict) and action == "rename":
            place[str(key)[::-1]] = place.pop(key)
        else:
            del place[key]
        file.write_text(yaml.safe_dump(data, allow_unicode=True))
        return f"{file.name}: {action} {key!r} by {str(value)[:40]!r}"
    position = rng.randrange(len(content) + 1)
    action = rng.choice(("cut", "insert", "flip", "repeat", "empty", "kind"))
    if action == "kind":
        file.unlink()
        rng.choice((file.mkdir, lambda: os.mkfifo(file), lambda: file.symlink_to("/dev/zero"), lambda: None))()
        return f"{file.name}: another kind of file"
    word = rng.choice(WORDS)
    end = position + 4
    changed = {
        "cut": content[:position],
        "insert": content[:position] + word + content[position:],
        "flip": content[:position] + bytes(byte ^ 255 for byte in content[position:end]) + content[end:],
        "repeat": content + content[position:],
        "empty": b"",
    }[action]
    file.write_bytes(changed)
    return f"{file.name}: {action} at {position} {word[:20]!r}"


def _nodes(data: object) -> list:
    inner = data.values() if isinstance(data, dict) else data if isinstance(data, list) else ()
    return [*([data] if isinstance(data, dict | list) and data else []), *itertools.chain(*map(_nodes, inner))]


def _keys(node: dict | list) -> list:
    return list(node) if isinstance(node, dict) else list(range(len(node)))


def state_of(folder: Path) -> str:
    """Digest what lies in a folder."""
    content = hashlib.sha256()
    for path in sorted(folder.rglob("*")):
        content.update(str(path.relative_to(folder)).encode())
        if path.is_file() and not path.is_symlink():
            content.update(path.read_bytes())
    return content.hexdigest()


def use(kind: str, folder: Path) -> str:
    """Use a damaged folder as a user would; return "used" or "refused", or what went wrong."""
    robot = Robot.load(config_folder() / "robot" / "mgr.yaml")
    try:
        if kind == "recording":
            from_recording(read_recording(folder, robot))
        elif kind == "model":
            load_simulation(folder, robot)
        else:
            return _prepare(folder)
    except UserError as error:
        return "refused" if "\n" not in str(error) else f"more than one line: {error}"
    return "used"


def _prepare(folder: Path) -> str:
    arguments = [f"--config-dir={folder}", "robot=mine", "recording=of_mine", "output=out", "pictures=false"]
    error = io.StringIO()
    with contextlib.redirect_stderr(error), contextlib.redirect_stdout(io.StringIO()):
        status = run_command("prepare", arguments)
    made = Path("out").exists()
    shutil.rmtree("out", ignore_errors=True)
    if status not in (0, 2) or made != (status == 0) or "Traceback" in error.getvalue():
        return f"status {int(status)}, output {made}: {error.getvalue()[-500:]}"
    return "used" if status == 0 else "refused"


def run_case(index: int, seed: int, sound: dict[str, Path]) -> Case:
    """Damage a copy of one of the sound folders by the case's own random numbers, use it, and say how it ended."""
    rng = random.Random(f"{seed} {index}")
    kind = KINDS[index % len(KINDS)]
    folder = Path("damaged")
    shutil.rmtree(folder, ignore_errors=True)
    shutil.copytree(sound[kind], folder)
    names = ("*.yaml", "*.csv", "*.safetensors")
    files = sorted(file for name in names for file in folder.rglob(name))
    damage = "; ".join(_damaged(rng, files) for _ in range(rng.choice((1, 1, 2))))
    before = state_of(folder)
    signal.alarm(LONGEST_S)
    try:
        outcome = use(kind, folder)
    except Hang:
        outcome = f"hangs for {LONGEST_S} s"
    except Exception as error:
        outcome = f"{type(error).__name__}: {''.join(traceback.format_exception(error))[-1500:]}"
    finally:
        signal.alarm(0)
    if Path("ran").exists():
        outcome = "ran code"
        Path("ran").unlink()
    if state_of(folder) != before:
        outcome = "changed its input"
    return Case(index, kind, outcome, damage)


def _damaged(rng: random.Random, files: list[Path]) -> str:
    whole = [file for file in files if file.is_file() and not file.is_symlink()]
    try:
        return damage_file(rng, rng.choice(whole))
    except (yaml.YAMLError, IndexError, RecursionError, ValueError):  # damaged already: that will do
        return "damaged before"


def campaign(count: int, seed: int, state: Path) -> list[Case]:
    """Run the cases that are not yet in the state file; return all."""
    state.parent.mkdir(parents=True, exist_ok=True)
    done = [Case(**json.loads(line)) for line in state.read_text().splitlines()] if state.exists() else []
    state = state.absolute()

    def hang(signal_number: int, frame: object) -> None:
        raise Hang

    former = signal.signal(signal.SIGALRM, hang)
    try:
        with tempfile.TemporaryDirectory() as place, contextlib.chdir(place):
            sound = sound_folders(Path(place))
            with state.open("a") as record:
                for index in range(len(done), count):
                    done.append(run_case(index, seed, sound))
                    record.write(json.dumps(done[-1]._asdict()) + "\n")
                    record.flush()
    finally:
        signal.signal(signal.SIGALRM, former)
    return done


def failures(cases: list[Case]) -> list[Case]:
    """Return the cases that are neither used nor refused."""
    return [case for case in cases if case.outcome not in ("used", "refused")]


def main() -> None:
    """Run the campaign, show a table, and end with 1 if a case failed."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--count", type=int, default=10_000)
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--state", type=Path, default=Path("outputs/fuzz.jsonl"))
    options = parser.parse_args()
    cases = campaign(options.count, options.seed, options.state)
    failed = failures(cases)
    for kind in KINDS:
        own = collections.Counter("failed" if case in failed else case.outcome for case in cases if case.kind == kind)
        print(f"{kind:<14} {dict(own)}")
    for case in failed[:20]:
        print(f"{case.number} {case.kind} {case.damage}\n  {case.outcome}")
    raise SystemExit(bool(failed))


if __name__ == "__main__":
    main()
