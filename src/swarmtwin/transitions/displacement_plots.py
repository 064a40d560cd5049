"""A picture of what was recorded: where, with which commands, and which displacements followed."""

from pathlib import Path

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from swarmtwin.plotting import FLOOR, MEASURED, style
from swarmtwin.transitions.preparation import stored_transitions
from swarmtwin.transitions.source import TransitionSource


def draw_preparation(made: Path, output: Path) -> None:
    """Draw into `output` what `swarmtwin prepare` left in `made`.

    Raises:
        UserError: there are no transitions, or they are damaged.
    """
    coverage_figure(stored_transitions(made)).savefig(output / "coverage.png")


def coverage_figure(transitions: TransitionSource, most_dots: int = 4000, most_runs: int = 40) -> Figure:
    """Draw some runs in the arena, the first two numbers of the commands, and the displacements that followed."""
    command, moved = _spread_evenly(transitions, most_dots)
    columns = list(transitions.robot.command.items())
    with style():
        figure = Figure(figsize=(10, 3.2), layout="constrained")
        runs, commands, displacements = figure.subplots(1, 3)
        _draw_runs(runs, transitions, most_runs)
        second = command[:, 1] if len(columns) > 1 else np.zeros(len(command))
        commands.plot(command[:, 0], second, ".", color=FLOOR, markersize=2, alpha=0.5)
        labels = [f"{name}, {column.unit}" for name, column in columns[:2]]
        commands.set(title="commands", xlabel=labels[0], ylabel=labels[1] if len(labels) > 1 else "")
        turn_deg = np.degrees(moved[:, 2])
        displacements.plot(turn_deg, moved[:, 0], ".", color=FLOOR, markersize=2, alpha=0.5)
        displacements.set(title="displacements", xlabel="turn, °", ylabel="forward, mm")
    return figure


def _spread_evenly(transitions: TransitionSource, most: int) -> tuple[np.ndarray, np.ndarray]:
    """Return the commands (D, m) and displacements (D, 3) of at most so many transitions, evenly spread."""
    chosen = np.linspace(0, len(transitions) - 1, min(most, len(transitions))).astype(int)
    first, command, moved = 0, [], []
    for block in transitions.blocks(("command", "displacement")):
        rows = len(block["command"])
        own = chosen[slice(*np.searchsorted(chosen, [first, first + rows]))] - first
        command.append(block["command"][own])
        moved.append(block["displacement"][own])
        first += rows
    return np.concatenate(command), np.concatenate(moved)


def _draw_runs(panel: Axes, transitions: TransitionSource, most: int, most_poses: int = 200) -> None:
    """Draw the ways of the first runs, of long ones how they begin."""
    ways: dict[tuple[int, int], np.ndarray] = {}
    runs: list[int] = []
    for block in transitions.blocks(("run", "vehicle", "pose")):
        runs = np.unique(np.append(runs, block["run"])).astype(int)[:most].tolist()
        for run in np.intersect1d(runs, block["run"]):
            for vehicle in np.unique(block["vehicle"][block["run"] == run]):
                pose = block["pose"][(block["run"] == run) & (block["vehicle"] == vehicle)]
                before = ways.get((run, vehicle), pose[:0])
                ways[run, vehicle] = np.concatenate([before, pose])[:most_poses]
    for (run, _), pose in ways.items():
        if run in runs:
            panel.plot(pose[:, 0], pose[:, 1], color=MEASURED, linewidth=0.6, alpha=0.6)
    which = (
        "how the first {} runs begin" if any(len(pose) == most_poses for pose in ways.values()) else "the first {} runs"
    )
    panel.set(title=which.format(min(most, len(transitions.runs))), xlabel="x, mm", ylabel="y, mm")
    panel.set_aspect("equal")
