"""A deployment's journal becomes an ordinary recording, with all that was seen and sent as tables beside it."""

from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import yaml

from swarmtwin.deploy.control.journal import JOURNAL, read_journal
from swarmtwin.recordings.recording import Header, Track
from swarmtwin.recordings.synchronising import synchronised
from swarmtwin.recordings.writing import write_recording
from swarmtwin.robot import POSE_COLUMNS, Robot

ABOUT = "deployment.yaml"
SUPERVISOR_LOG = "supervisor.jsonl"


@dataclass
class Sent:
    """A command to one vehicle."""

    sent_s: float
    command: list[float]
    requested: list[float] | None = None
    reason: str = ""


@dataclass
class Run:
    """What one drive saw and sent, by vehicle.

    Attributes:
        name: of the run.
        seen: (captured_s, pose) in order.
        sent: commands in order.
    """

    name: str
    seen: dict[str, list[tuple[float, list[float]]]] = field(default_factory=dict)
    sent: dict[str, list[Sent]] = field(default_factory=dict)

    def tracks(self, robot: Robot, begun_s: float, longest_gap_s: float = 0.2) -> list[Track]:
        """Return one row for each command, at the time it was sent; those of a repeated stop at the period's pace."""
        poses = {
            vehicle: (np.array([when for when, _ in seen]) - begun_s, np.array([pose for _, pose in seen]))
            for vehicle, seen in self.seen.items()
        }
        commands = {}
        for vehicle, sent in self.sent.items():
            rows = _without_repetitions(sent, robot)
            times = np.array([one.sent_s for one in rows]) - begun_s
            commands[vehicle] = (times, np.array([one.command for one in rows]))
        return synchronised(poses, commands, self.name, longest_gap_s)


def read_runs(folder: Path) -> list[Run]:
    """Read a journal, and what a supervisor beside it did after it, into runs."""
    runs: list[Run] = []
    pending: Mapping[str, Any] | None = None
    for line in read_journal(folder / JOURNAL):
        kind = line["kind"]
        if kind == "run":
            runs.append(Run(line["name"]))
        if not runs:
            continue
        run = runs[-1]
        if kind == "sending":
            pending = line
        elif kind == "sighting":
            for vehicle, pose in line["poses"].items():
                run.seen.setdefault(vehicle, []).append((line["captured_s"], pose))
        elif kind == "period":
            pending = None
            for index, vehicle in enumerate(line["vehicles"]):
                one = Sent(line["sent_s"], line["sent"][index], line["requested"][index], line["reason"][index])
                run.sent.setdefault(vehicle, []).append(one)
        elif kind == "stop":
            _add_all(run, line["sent_s"], line["sent"], f"stop: {line['reason']}")
    if pending is not None:
        _add_all(runs[-1], pending["now_s"], pending["sent"], "sent or about to be when the controller was killed")
    if runs:
        _add_supervisors_stops(runs[-1], folder / SUPERVISOR_LOG)
    for run in runs:
        for sent in run.sent.values():
            sent.sort(key=lambda one: one.sent_s)
    return runs


def write_deployment(folder: Path, robot: Robot, header: Header) -> list[Run]:
    """Write the recording that a journal in `folder` holds: `recording.yaml`, `runs/`, and both raw tables."""
    runs = [run for run in read_runs(folder) if run.sent]
    times = [one.sent_s for run in runs for sent in run.sent.values() for one in sent]
    times += [when for run in runs for seen in run.seen.values() for when, _ in seen]
    begun_s = min(times, default=0.0)
    tracks = [track for run in runs for track in run.tracks(robot, begun_s)]
    write_recording(folder, robot, header, tracks)
    _poses(runs, begun_s).to_parquet(folder / "poses.parquet", index=False)
    _commands(runs, robot, begun_s).to_parquet(folder / "sent.parquet", index=False)
    return runs


def write_about(folder: Path, about: Mapping[str, Any]) -> None:
    """Write `deployment.yaml`: with what, under which settings, and what came of it."""
    (folder / ABOUT).write_text(yaml.safe_dump(dict(about), sort_keys=False, allow_unicode=True))


def _add_all(run: Run, sent_s: float, commands: Mapping[str, list[float]], reason: str) -> None:
    for vehicle, command in commands.items():
        run.sent.setdefault(vehicle, []).append(Sent(sent_s, command, None, reason))


def _add_supervisors_stops(run: Run, log: Path) -> None:
    if not log.exists():
        return
    for line in read_journal(log):
        if line.get("event") == "zeros":
            _add_all(run, line["sent_s"], line["sent"], "stop: by the supervisor")


def _without_repetitions(sent: Iterable[Sent], robot: Robot) -> list[Sent]:
    """Return commands without those of rest that only repeat the one before, sooner than a period after it."""
    rest = robot.command_at_rest.tolist()
    rows: list[Sent] = []
    for one in sent:
        if rows and one.sent_s <= rows[-1].sent_s:
            continue
        soon = bool(rows) and one.sent_s - rows[-1].sent_s < 0.95 * robot.period_s
        if not (soon and one.command == rest and rows[-1].command == rest):
            rows.append(one)
    return rows


def _poses(runs: Iterable[Run], begun_s: float) -> pd.DataFrame:
    rows = [
        (run.name, when - begun_s, vehicle, *pose)
        for run in runs
        for vehicle, seen in run.seen.items()
        for when, pose in seen
    ]
    return pd.DataFrame(rows, columns=["run", "time_s", "vehicle", *POSE_COLUMNS]).sort_values("time_s")


def _commands(runs: Iterable[Run], robot: Robot, begun_s: float) -> pd.DataFrame:
    columns = robot.command_columns
    unknown = [float("nan")] * len(columns)
    rows = [
        (run.name, one.sent_s - begun_s, vehicle, *one.command, *(one.requested or unknown), one.reason)
        for run in runs
        for vehicle, sent in run.sent.items()
        for one in sent
    ]
    names = ["run", "time_s", "vehicle", *columns, *(f"requested_{name}" for name in columns), "reason"]
    return pd.DataFrame(rows, columns=names).sort_values("time_s")
