"""A campaign of sudden deaths: each command is killed at a random moment, called again, and must end as if undisturbed.

`python tests/campaigns/kill.py --count 200 --seed 1 --state outputs/kill.jsonl` goes on where it was broken off;
`--table` shows what is in the state file. Processes are forked from this one, which has imported everything, so that
the moments fall upon what a command does; one in eight starts from the console, imports and all. A case fails if the
second call does, or if what it leaves differs from what an undisturbed call leaves: the output's content, the
registered models and their files, the inputs, a run that stays RUNNING, a file left lying about.
"""

import argparse
import collections
import contextlib
import importlib
import json
import os
import random
import re
import shutil
import signal
import sqlite3
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator
from pathlib import Path
from typing import NamedTuple

import numpy as np
import yaml
from forked import fork

from swarmtwin.commands.catalogue import COMMANDS
from swarmtwin.files import folder_digest
from swarmtwin.standin.physics import Physics
from swarmtwin.tracking.models import model_data

REPOSITORY = Path(__file__).resolve().parents[2]
BIN = Path(sys.executable).parent
TRAINING = ("recipe.batch_size=64", "recipe.epochs=6", "seeds=1")
TASK = ("task=obstacle", "task.steps=40", "task.reach_mm=300", "task.distance_mm=360", "task.radius_mm=[5,10]")
SMALL = ("policy.layers=[16]", "policy.worlds=4", "policy.steps=100", "policy.random_steps=20", "policy.batch_size=64")
CALLS: dict[str, tuple[str, ...]] = {
    "record": ("robot=mgr", "runs=12", "steps=12", "seed=1", "output=out"),
    "import": ("robot=create", "source=mrclam", "path=foreign", "run_s=5", "output=out"),
    "prepare": ("robot=mgr", "recording=reference", "output=out"),
    "generate": (
        *("robot=mgr", "recording=reference", "generator.mean_model_steps=20", "generator.noise_steps=20"),
        *("generator.members=2", "generator.batch_size=64", "output=out"),
    ),
    "train": ("robot=mgr", "recording=reference", "model=mlp", *TRAINING, "output=out"),
    "evaluate": ("robot=mgr", "simulation=models/mlp", "recording=measured", "output=out"),
    "tune": (
        *("robot=mgr", "recording=reference", "model=kinematic", "recipe.epochs=2", "recipe.batch_size=64"),
        *("trials=2", "workers=1", "~space", "+space={recipe.learning_rate: {low: 0.001, high: 0.03}}", "study=s"),
    ),
    "diagnose": ("robot=mgr", "reference=reference", "measured=measured", "output=out"),
    "learn": ("simulation=models/mlp", *TASK, *SMALL, "evaluate_every=50", "scenes=60", "seeds=1", "output=out"),
    "rollout": ("policy=policy", "count=10", "video=false", "output=out"),
    "promote": ("robot=mgr", "candidate=models/mlp", "recording=measured", "baseline=worn"),
    "experiment": (
        *("name=dynamics", "robot=mgr", "models=models", "train_vehicle=reference", "other_vehicle=measured"),
        *("open_loop=measured", "output=out"),
    ),
}
PIPELINE = "dvc repro"
MANNERS = {"SIGKILL": 8, "SIGKILL of children, then of it": 2, "SIGINT": 3, "SIGTERM": 3}


class Case(NamedTuple):
    """One death: of which command, in which manner, when and in what state of the project, and how it ended."""

    number: int
    command: str
    manner: str
    start: str
    moment_s: float
    before: str
    died: str
    outcome: str


class Undisturbed(NamedTuple):
    """What a call leaves that nothing disturbs.

    Attributes:
        seconds: that it takes, from "here" or the "console", in a project with runs in its store or a "new" one.
        files: below the project, without MLflow's.
        contents: of those files of its output that are the same each time, as bytes.
        registered: digests of the registered models' content by alias.
    """

    seconds: dict[str, float]
    files: frozenset[str]
    contents: dict[str, bytes]
    registered: dict[str, str]


class Ended(NamedTuple):
    """How a process ended: its exit status, negative for a signal, and what it said."""

    status: int
    shown: str
    error: str
    seconds: float


def spawn(command: list[str], folder: Path, place: Path) -> int:
    """Start a program in a session and a folder of its own; return its id."""
    with (place / "shown").open("w") as shown, (place / "error").open("w") as error:
        return subprocess.Popen(
            command,
            cwd=folder,
            stdout=shown,
            stderr=error,
            start_new_session=True,
            preexec_fn=lambda: signal.signal(signal.SIGINT, signal.SIG_DFL),  # it may be ignored here
        ).pid


def ended(process: int, place: Path, since: float, longest_s: float = 300) -> Ended:
    """Wait until a process, and with it its whole group, has ended; kill it if that takes too long."""
    status = None
    while status is None and time.monotonic() - since < longest_s:
        found, how = os.waitpid(process, os.WNOHANG)
        status = os.waitstatus_to_exitcode(how) if found else None
        time.sleep(0.005)
    seconds = time.monotonic() - since
    if status is None:
        os.killpg(process, signal.SIGKILL)
        os.waitpid(process, 0)
    error = (place / "error").read_text(errors="replace")
    if not _group_ends(process):
        os.killpg(process, signal.SIGKILL)
        error += "\nTraceback: a child outlived it"
    return Ended(-99 if status is None else status, (place / "shown").read_text(), error, seconds)


def _group_ends(group: int) -> bool:
    for _ in range(500):
        try:
            os.killpg(group, 0)
        except ProcessLookupError:
            return True
        time.sleep(0.01)
    return False


def kill(process: int, manner: str) -> None:
    """Let a process die: by SIGKILL with all its children, by Ctrl-C in its terminal, or by SIGTERM to it alone."""
    with contextlib.suppress(ProcessLookupError):
        if manner == "SIGINT":
            os.killpg(process, signal.SIGINT)
        elif manner == "SIGTERM":
            os.kill(process, signal.SIGTERM)
        else:
            if manner != "SIGKILL":
                for child in Path(f"/proc/{process}/task/{process}/children").read_text().split():
                    os.kill(int(child), signal.SIGKILL)
                time.sleep(0.05)
            os.killpg(process, signal.SIGKILL)


def databases(project: Path) -> Iterator[sqlite3.Cursor]:
    """Give a cursor of each store in a project."""
    for file in (project / "mlflow.db", project / "repository" / "mlflow.db"):
        if file.exists():
            with contextlib.closing(sqlite3.connect(file)) as connection:
                yield connection.cursor()


def registered(project: Path) -> dict[str, str]:
    """Return the digest of what each alias of a registered model leads to, as the files say."""
    found = {}
    query = (
        "SELECT a.name, a.alias, v.source FROM registered_model_aliases a LEFT JOIN model_versions v "
        "ON v.name = a.name AND v.version = a.version"
    )
    for cursor in databases(project):
        for name, alias, source in cursor.execute(query):
            folder = model_data(Path((source or "").removeprefix("file://")))
            found[f"{name}@{alias}"] = folder_digest(folder) if source and folder.is_dir() else "nothing"
    return found


def half_versions(project: Path) -> list[str]:
    """Return the versions of registered models whose files are not those that were registered."""
    query = (
        "SELECT v.name, v.version, v.source, t.value FROM model_versions v LEFT JOIN model_version_tags t "
        "ON t.name = v.name AND t.version = v.version AND t.key = 'digest'"
    )
    wrong = []
    for cursor in databases(project):
        for name, version, source, digest in cursor.execute(query):
            folder = model_data(Path(source.removeprefix("file://")))
            if not folder.is_dir() or folder_digest(folder) != digest:
                wrong.append(f"{name} version {version}")
    return wrong


def still_running(project: Path) -> list[str]:
    """Return the names of the runs that MLflow takes to be going on."""
    query = "SELECT name FROM runs WHERE status = 'RUNNING'"
    return [name for cursor in databases(project) for (name,) in cursor.execute(query)]


class Campaign:
    """The projects that commands die in, and what an undisturbed call leaves in them."""

    def __init__(self, place: Path, names: list[str]) -> None:
        self.place, self.sound, self.project = place, place / "sound", place / "project"
        self._undisturbed: dict[tuple[str, bool], Undisturbed] = {}
        self._former = place / "former"
        self.sound.mkdir()
        os.environ["TMPDIR"] = str(place)
        tempfile.tempdir = str(place)
        Physics.bank_rows = 2048
        for name in COMMANDS:
            importlib.import_module(f"swarmtwin.commands.{COMMANDS[name].module}")
        importlib.import_module("swarmtwin.studies.dynamics.study")
        self._make_sound()
        if PIPELINE in names:
            self._make_repository()

    def _make_sound(self) -> None:
        """Make recordings, models, a policy, foreign data, and a store with a run in it."""
        self.project.mkdir()
        recording = ("robot=mgr", "vehicle=1", "runs=30", "steps=30")
        self._must("record", *recording, "seed=1", "output=reference")
        self._must("record", *recording, "seed=2", "effects=[{name: gain_change, gain: 0.8}]", "output=measured")
        self._must("record", *recording, "seed=3", "effects=[{name: gain_change, gain: 0.4}]", "output=worn_recording")
        self._must("prepare", "robot=mgr", "recording=worn_recording", "output=worn")
        training = ("robot=mgr", "recording=reference", "model.steps=120", "recipe.batch_size=64", "seeds=1")
        for model in ("kinematic", "mlp"):
            self._must("train", *training, f"model={model}", "register=false", f"output=models/{model}")
        learning = ("simulation=models/mlp", *TASK, *SMALL, "scenes=60", "seeds=1", "register=false")
        self._must("learn", *learning, "evaluate_every=50", "output=policy")
        foreign = self.project / "foreign"
        foreign.mkdir()
        time_s = np.arange(0, 60, 0.02)
        for number in (1, 2):
            turn = np.full_like(time_s, 0.1 * number)
            heading = 0.1 * number * time_s
            command = np.column_stack([time_s, np.full_like(time_s, 0.05), turn])
            place = (0.05 / turn * np.sin(heading), number - 0.05 / turn * np.cos(heading))
            pose = np.column_stack([time_s, *place, np.arctan2(np.sin(heading), np.cos(heading))])
            np.savetxt(foreign / f"Robot{number}_Odometry.dat", command, fmt="%.3f")
            np.savetxt(foreign / f"Robot{number}_Groundtruth.dat", pose, fmt="%.6f")
        self.sound.rmdir()
        shutil.copytree(self.project, self.sound)

    def _make_repository(self) -> None:
        """Make a repository whose pipeline prepares the recording and trains a model on it."""
        repository = self.sound / "repository"
        for name in ("conf", "src"):
            shutil.copytree(REPOSITORY / name, repository / name, ignore=shutil.ignore_patterns("__pycache__"))
        shutil.copy(REPOSITORY / "dvc.yaml", repository)
        shutil.copytree(self.sound / "reference", repository / "data" / "mgr" / "reference")
        model = repository / "conf" / "model" / "kinematic.yaml"
        model.write_text(yaml.safe_dump(yaml.safe_load(model.read_text()) | {"steps": 60}, sort_keys=False))
        program = repository / ".venv" / "bin" / "swarmtwin"
        program.parent.mkdir(parents=True)
        source = f"{self.project}/repository/src"
        program.write_text(f'#!/bin/sh\nPYTHONPATH={source} exec {sys.executable} -m swarmtwin_here "$@"\n')
        python = program.with_name("python")
        python.write_text(f'#!/bin/sh\nPYTHONPATH={source} exec {sys.executable} "$@"\n')
        for executable in (program, python):
            executable.chmod(0o755)
        (repository / "src" / "swarmtwin_here.py").write_text("from swarmtwin.commands import main\nmain()\n")
        shutil.copy(REPOSITORY / ".gitignore", repository)
        for command in (["git", "init", "--quiet"], [sys.executable, "-m", "dvc", "init", "--quiet"]):
            subprocess.run(command, cwd=repository, check=True)

    def _must(self, *arguments: str) -> Ended:
        answer = self.call(arguments[0], list(arguments[1:]))
        if answer.status:
            raise SystemExit(f"an undisturbed call fails: {' '.join(arguments)}\n{answer.error}")
        return answer

    def call(self, name: str, arguments: list[str], start: str = "here") -> Ended:
        """Call a command in the project, and wait for its end."""
        since = time.monotonic()
        return ended(self.start(name, arguments, start), self.place, since)

    def start(self, name: str, arguments: list[str], start: str) -> int:
        """Start a command in the project; return the process's id."""
        if name == PIPELINE:
            repro = [sys.executable, "-m", "dvc", "repro", "dynamics@mgr-kinematic"]
            return spawn(repro, self.project / "repository", self.place)
        if start == "console":
            return spawn([str(BIN / "swarmtwin"), name, *arguments], self.project, self.place)
        return fork([name, *arguments], self.project, self.place)

    def renew(self, before: str, name: str) -> None:
        """Bring the project back to what it was: with a "new" store, with runs, or with a "former" output."""
        shutil.rmtree(self.project, ignore_errors=True)
        leave = () if name == PIPELINE else ("repository",)
        shutil.copytree(self.sound, self.project, symlinks=True, ignore=shutil.ignore_patterns(*leave))
        if before == "new":
            shutil.rmtree(self.project / "mlruns")
            for file in self.project.glob("*mlflow.db*"):
                file.unlink()
        if before == "former":
            shutil.copytree(self._former / name, self.project / "out")

    def undisturbed(self, name: str, before: str) -> Undisturbed:
        """Call a command, undisturbed, and note what it leaves; where it replaces an output, that says so in it."""
        key = (name, before == "former")
        if key in self._undisturbed:
            return self._undisturbed[key]
        seconds, contents = {}, []
        for state in ("former", "former") if before == "former" else ("new", "runs"):
            self.renew(state, name)
            seconds[state] = self._must(name, *arguments_of(name, state)).seconds
            contents.append(self.outputs(name))
        if before != "former" and (self.project / "out").exists():
            shutil.copytree(self.project / "out", self._former / name)
        same = {file: content for file, content in contents[0].items() if contents[1].get(file) == content}
        self._undisturbed[key] = Undisturbed(seconds, self.files(), same, registered(self.project))
        return self._undisturbed[key]

    def outputs(self, name: str) -> dict[str, bytes]:
        """Return the contents of what a command has made, of the files that say something about the result."""
        inputs = {file.relative_to(self.sound) for file in self.sound.rglob("*")}
        found = (self.project / file for file in self.files())
        made = (file for file in found if file.is_file() and file.relative_to(self.project) not in inputs)
        return {str(file.relative_to(self.project)): file.read_bytes() for file in made}

    def files(self) -> frozenset[str]:
        """Return what lies in the project, apart from what MLflow, Optuna, Git, DVC and Python keep for themselves."""
        own = re.compile(r"(^|/)(mlruns|\.git|\.dvc|__pycache__)(/|$)|(^|/)\.?mlflow\.db[^/]*$|\.db(-journal)?$")
        names = (str(file.relative_to(self.project)) for file in self.project.rglob("*"))
        return frozenset(name for name in names if not own.search(name))

    def faults(self, name: str, again: Ended, whole_before: bool, before: str) -> list[str]:
        """Return what is wrong after the second call."""
        expected = self.undisturbed(name, before)
        faults = []
        done = whole_before and again.status == 2 and "already holds something" in again.error
        if "Traceback" in again.error or (again.status != 0 and not done):
            faults.append(f"the second call ends with {again.status}: {again.error[-600:]}")
        if lost := expected.files - self.files():
            faults.append(f"missing: {', '.join(sorted(lost)[:5])}")
        if left := self.files() - expected.files:
            faults.append(f"left lying: {', '.join(sorted(left)[:5])}")
        if other := self.unlike(name, before):
            faults.append(f"another content: {', '.join(sorted(other)[:5])}")
        if changed := [file for file in self.inputs() if not self._is_unchanged(file)]:
            faults.append(f"inputs changed: {', '.join(map(str, changed[:5]))}")
        if (found := registered(self.project)) != expected.registered:
            faults.append(f"registered: {found} in place of {expected.registered}")
        if half := half_versions(self.project):
            faults.append(f"half versions: {', '.join(half)}")
        if running := still_running(self.project):
            faults.append(f"still RUNNING: {', '.join(running)}")
        return faults

    def inputs(self) -> list[Path]:
        """Return the files that no command may change, below the project."""
        folders = ("reference", "measured", "models", "policy", "foreign", "repository/data")
        here = (self.sound / folder for folder in folders if (self.project / folder).exists())
        found = (file for folder in here for file in folder.rglob("*") if file.is_file())
        return [file.relative_to(self.sound) for file in found]

    def _is_unchanged(self, file: Path) -> bool:
        now = self.project / file
        return now.is_file() and now.read_bytes() == (self.sound / file).read_bytes()

    def run_case(self, number: int, seed: int, names: list[str]) -> Case:
        """Let a command die at a moment of the case's own random numbers, call it again, and say how that ended."""
        rng = random.Random(f"{seed} {number}")
        name = names[number % len(names)]
        manner = rng.choices(list(MANNERS), list(MANNERS.values()))[0]
        start = "console" if name == PIPELINE or rng.random() < 1 / 8 else "here"
        before = rng.choice(("new", "runs", "former" if "output=out" in CALLS.get(name, ()) else "runs"))
        arguments = arguments_of(name, before)
        if before == "former":
            self.undisturbed(name, "runs")  # leaves what is replaced
        lasts_s = self.undisturbed(name, before).seconds[before]
        if start == "console" and name != PIPELINE:
            lasts_s = min(lasts_s, 0.5) if rng.random() < 0.5 else lasts_s + 6  # what imports take
        moment_s = rng.uniform(0, lasts_s)
        self.renew(before, name)
        since = time.monotonic()
        process = self.start(name, arguments, start)
        time.sleep(moment_s)
        kill(process, manner)
        died = ended(process, self.place, since)
        whole = not self.unlike(name, before)
        faults = _faults_of_death(died, manner, name)
        again = self.call(name, arguments)
        faults += self.faults(name, again, whole, before)
        how = "finished before" if died.status == 0 else "died"
        outcome = "; ".join(faults) or ("its output was whole" if again.status else "went on")
        return Case(number, name, manner, start, round(moment_s, 3), before, how, outcome)

    def unlike(self, name: str, before: str) -> list[str]:
        """Return the files of the output that are not there, or have another content than undisturbed."""
        made, expected = self.outputs(name), self.undisturbed(name, before).contents
        return [file for file, content in expected.items() if made.get(file) != content]


def arguments_of(name: str, before: str) -> list[str]:
    """Return a command's arguments, in a project of that state."""
    return [*CALLS.get(name, ()), *(["overwrite=true"] if before == "former" else [])]


def _faults_of_death(died: Ended, manner: str, name: str) -> list[str]:
    """Return what is wrong with the way in which a process ended that was asked to."""
    if "SIGKILL" in manner or name == PIPELINE:
        return []
    own = died.error[died.error.find("Traceback") :] if "Traceback" in died.error else ""
    if own and "swarmtwin/" not in own.replace("bin/swarmtwin", "").replace("_impl_swarmtwin", ""):
        return []  # Python itself was starting: not a line of ours had run
    faults = ["a traceback: " + own[-600:]] if own else []
    if died.status not in (0, 130, -signal.SIGINT, -signal.SIGTERM):
        faults.append(f"{manner} ends it with {died.status}: {died.error[-600:]}")
    return faults


def campaign(count: int, seed: int, state: Path, names: list[str], again: bool = False) -> list[Case]:
    """Run the cases that are not yet in the state file, or those that failed again; return all."""
    done, state = {case.number: case for case in read_state(state)}, state.absolute()
    state.parent.mkdir(parents=True, exist_ok=True)
    open_cases = [number for number in range(count) if number not in done]
    if again:
        open_cases = [case.number for case in failures(list(done.values()))]
    if not open_cases:
        return list(done.values())
    os.environ.pop("MLFLOW_TRACKING_URI", None)
    place = Path(tempfile.mkdtemp()).resolve()  # a TemporaryDirectory would be removed where a forked process ends
    try:
        made = Campaign(place, names)
        with state.open("a") as record:
            for number in open_cases:
                done[number] = made.run_case(number, seed, names)
                record.write(json.dumps(done[number]._asdict()) + "\n")
                record.flush()
    finally:
        shutil.rmtree(place)
    return list(done.values())


def read_state(state: Path) -> list[Case]:
    """Return the cases in a state file; of one that was run again, the last."""
    lines = state.read_text().splitlines() if state.exists() else []
    return list({case.number: case for case in (Case(**json.loads(line)) for line in lines)}.values())


def failures(cases: list[Case]) -> list[Case]:
    """Return the cases that did not end as if undisturbed."""
    return [case for case in cases if case.outcome not in ("went on", "its output was whole")]


def table(cases: list[Case]) -> str:
    """Return a table of what became of each command, in Markdown."""
    failed = failures(cases)
    heads = ("command", "killed", "interrupted", "went on", "output was whole", "came too late", "failed")
    lines = [f"| {' | '.join(heads)} |", f"|{' --- |' * len(heads)}"]
    for name in dict.fromkeys(case.command for case in cases) | {"all": None}:
        own = [case for case in cases if name in (case.command, "all")]
        killed = sum("SIGKILL" in case.manner for case in own)
        ends = collections.Counter(
            "failed" if case in failed else "too late" if case.died == "finished before" else case.outcome
            for case in own
        )
        counts = (ends[end] for end in ("went on", "its output was whole", "too late", "failed"))
        lines.append(f"| {' | '.join(map(str, (name, killed, len(own) - killed, *counts)))} |")
    return "\n".join(lines)


def main() -> None:
    """Run the campaign, show a table, and end with 1 if a case failed."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--count", type=int, default=200)
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--state", type=Path, default=Path("outputs/kill.jsonl"))
    parser.add_argument("--commands", nargs="*", default=[*CALLS, PIPELINE])
    parser.add_argument("--again", action="store_true", help="run those cases again that failed")
    parser.add_argument("--table", action="store_true", help="show what is in the state file, and run nothing")
    options = parser.parse_args()
    if options.table:
        print(table(read_state(options.state)))
        return
    cases = campaign(options.count, options.seed, options.state, options.commands, options.again)
    print(table(cases))
    for case in failures(cases):
        print(f"{case.number} {case.command} ({case.manner}, {case.start}, {case.moment_s} s): {case.outcome}")
    raise SystemExit(bool(failures(cases)))


if __name__ == "__main__":
    main()
