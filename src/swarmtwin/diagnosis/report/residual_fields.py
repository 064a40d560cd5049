"""Residual fields: the mean standardised residual over parts of the situation, with errors that take runs as blocks."""

from collections.abc import Sequence
from itertools import combinations
from typing import NamedTuple

import numpy as np

from swarmtwin.geometry import rotate
from swarmtwin.robot import Robot
from swarmtwin.transitions import Transitions

VEHICLE_FRAME = ("forward", "left", "turn", "way", "turning")
PLACE_LABELS = ("x, mm", "y, mm")
ARENA_FRAME = (*VEHICLE_FRAME, "x", "y")


class Axis(NamedTuple):
    """One number of the situation to lay a residual over.

    Attributes:
        label: for a person, with its unit.
        values: (N,), NaN where it is unknown.
        edges: of the bins, ascending; values beyond the ends count to the outermost bins.
        names: of the bins, where they are no range of numbers.
    """

    label: str
    values: np.ndarray
    edges: np.ndarray
    names: tuple[str, ...] = ()


class Field(NamedTuple):
    """Means over bins: B bins of one axis, or A × B of two.

    Attributes:
        mean: of what was averaged, NaN in bins with too little to say.
        standard_error: of the mean, from its scatter over blocks.
        transitions: in each bin.
    """

    mean: np.ndarray
    standard_error: np.ndarray
    transitions: np.ndarray

    @property
    def strength(self) -> float:
        """Mean square of the means over the transitions, less what their errors add to it; 0 where nothing is known."""
        known = np.isfinite(self.mean)
        if not known.any():
            return 0.0
        squares = self.mean[known] ** 2 - self.standard_error[known] ** 2
        return float(np.average(squares, weights=self.transitions[known]))


class FieldChoice(NamedTuple):
    """What a picture of a part of the situation shows: one or two axes, and the component that stands out most."""

    axes: tuple[Axis, ...]
    component: str

    @property
    def is_map(self) -> bool:
        """Whether it has two axes."""
        return len(self.axes) == 2

    @property
    def is_place(self) -> bool:
        """Whether its axes are those of the arena."""
        return self.axes[0].label == PLACE_LABELS[0]


def binned(axes: Sequence[Axis], values: np.ndarray, block: np.ndarray) -> Field:
    """Average values (N,) over bins of one or two axes; NaN values and places are left out.

    The standard error is that of a ratio of sums over blocks (N,): transitions of a block may hang together.
    """
    shape = tuple(len(axis.edges) - 1 for axis in axes)
    known = np.isfinite(values) & np.all([np.isfinite(axis.values) for axis in axes], axis=0)
    places = [
        np.searchsorted(axis.edges[1:-1], axis.values[known], side="right").clip(max=size - 1)
        for axis, size in zip(axes, shape, strict=True)
    ]
    cell = np.ravel_multi_index(tuple(places), shape)
    cells = int(np.prod(shape))
    blocks, index = np.unique(block[known], return_inverse=True)
    table = (len(blocks), cells)
    joint = index * cells + cell
    number = np.bincount(joint, minlength=len(blocks) * cells).reshape(table).astype(float)
    total = np.bincount(joint, weights=values[known], minlength=len(blocks) * cells).reshape(table)
    count, present = number.sum(axis=0), (number > 0).sum(axis=0)
    enough = (count >= 12) & (present >= 3)  # fewer transitions or blocks give no error that can be believed
    size = np.where(enough, count, np.nan)
    mean = total.sum(axis=0) / size
    scatter = ((total - mean * number) ** 2).sum(axis=0) * present / np.maximum(present - 1, 1)
    return Field(mean.reshape(shape), (np.sqrt(scatter) / size).reshape(shape), count.reshape(shape))


def blocks_of(transitions: Transitions) -> np.ndarray:
    """Return (N,) which block each transition is in: its run, or of few runs a piece of it."""
    if len(np.unique(transitions.run)) >= 5:  # fewer would leave most bins without an error
        return transitions.run
    piece = np.arange(len(transitions)) // 20  # some 10 s: longer than errors hang together
    return transitions.run * (piece.max(initial=0) + 1) + piece


def components(transitions: Transitions, simulated: np.ndarray, residual: np.ndarray) -> dict[str, np.ndarray]:
    """Return what can be asked of residuals (N, 3), each (N,), in standard deviations of the ordinary noise.

    `forward`, `left`, `turn`; `way` and `turning`: further than `simulated` (N, 3) displacements, or turned more,
    whatever their direction; `x` and `y` in the arena's frame; `away` from the nearest neighbour.
    """
    x_y = rotate(residual[:, :2], transitions.pose[:, 2])
    found = {
        "forward": residual[:, 0],
        "left": residual[:, 1],
        "turn": residual[:, 2],
        "way": residual[:, 0] * np.sign(simulated[:, 0]),
        "turning": residual[:, 2] * np.sign(simulated[:, 2]),
        "x": x_y[:, 0],
        "y": x_y[:, 1],
    }
    if transitions.neighbours.shape[1]:
        nearest = _nearest_neighbour(transitions)
        distance_mm = np.maximum(np.linalg.norm(nearest, axis=1), 1e-9)
        found["away"] = -(residual[:, :2] * nearest).sum(axis=1) / distance_mm
    return found


def field_choices(transitions: Transitions, parts: dict[str, np.ndarray]) -> dict[str, FieldChoice]:
    """Choose by name of a picture what it shows, from the components `parts` of the simulation's residual.

    Pictures: command, previous_command, place, heading, time, duration, neighbours, vehicle; those that the transitions
    say nothing about, or too little, are left out.
    """
    robot, block = transitions.robot, blocks_of(transitions)
    change = transitions.command - transitions.previous_command
    possible: dict[str, tuple[list[tuple[Axis, ...]], Sequence[str]]] = {
        "command": (_pairs(_command_axes(robot, transitions.command, "{}")), VEHICLE_FRAME),
        "previous_command": (_pairs(_command_axes(robot, change, "new − previous {}")), VEHICLE_FRAME),
        "place": ([_place_axes(transitions)], ARENA_FRAME),
        "heading": ([(_heading_axis(transitions),)], ARENA_FRAME),
        "time": ([(_time_axis(transitions, block),)], VEHICLE_FRAME),
        "duration": ([(_axis("length of the period, s", transitions.duration_s, 1),)], VEHICLE_FRAME),
    }
    if "away" in parts:
        distance_mm = np.linalg.norm(_nearest_neighbour(transitions), axis=1)
        possible["neighbours"] = ([(_axis("distance to the nearest neighbour, mm", distance_mm, 1),)], ("away", "way"))
    if len(np.unique(transitions.vehicle)) > 1:
        possible["vehicle"] = ([(_vehicle_axis(transitions),)], VEHICLE_FRAME)
    best = {
        name: max(
            (FieldChoice(axes, component) for axes in candidates for component in asked),
            key=lambda choice: binned(choice.axes, parts[choice.component], block).strength,
        )
        for name, (candidates, asked) in possible.items()
        if any(_varies(axis) for axis in candidates[0])
    }
    return {
        name: choice
        for name, choice in best.items()
        if np.isfinite(binned(choice.axes, parts[choice.component], block).mean).any()
    }


def _axis(label: str, values: np.ndarray, dimensions: int) -> Axis:
    """Cut the range of values (N,), rare outer ones left aside, into bins of equal width."""
    known = values[np.isfinite(values)]
    low, high = np.quantile(known, [0.005, 0.995]) if len(known) else (0.0, 1.0)
    if not low < high:
        low, high = low - 0.5, high + 0.5
    a_bin, most = {1: (40, 16), 2: (50, 10)}[dimensions]  # transitions in a bin on average; bins that can be read
    bins = int(np.clip((len(known) / a_bin) ** (1 / dimensions), 3, most))
    return Axis(label, values, np.linspace(low, high, bins + 1))


def _varies(axis: Axis) -> bool:
    """Say whether an axis has more than rounding errors to show."""
    known = axis.values[np.isfinite(axis.values)]
    return len(known) > 0 and bool(np.ptp(known) > 1e-6 * max(1e-9, np.abs(known).max()))


def _command_axes(robot: Robot, values: np.ndarray, label: str) -> list[Axis]:
    dimensions = min(2, len(robot.command))
    return [
        _axis(label.format(f"{name}, {column.unit}"), values[:, index], dimensions)
        for index, (name, column) in enumerate(robot.command.items())
    ]


def _pairs(axes: list[Axis]) -> list[tuple[Axis, ...]]:
    """Return all pairs of the axes that vary; a single one where there are no two."""
    varying = [axis for axis in axes if _varies(axis)]
    return list(combinations(varying, 2)) or [tuple(varying or axes)[:1]]


def _place_axes(transitions: Transitions) -> tuple[Axis, ...]:
    """Cover where was driven with squares."""
    pose = transitions.pose
    axes = [_axis(label, pose[:, index], 2) for index, label in enumerate(PLACE_LABELS)]
    area = float(np.prod([np.ptp(axis.edges) for axis in axes]))
    side = np.sqrt(area / np.prod([len(axis.edges) - 1 for axis in axes]))
    return tuple(
        axis._replace(edges=np.linspace(axis.edges[0], axis.edges[-1], max(2, round(np.ptp(axis.edges) / side)) + 1))
        for axis in axes
    )


def _time_axis(transitions: Transitions, block: np.ndarray) -> Axis:
    """Cut the session into bins of several blocks each."""
    axis = _axis("session time, min", transitions.time_s / 60, 1)
    bins = min(len(axis.edges) - 1, max(2, len(np.unique(block)) // 5))
    return axis._replace(edges=np.linspace(axis.edges[0], axis.edges[-1], bins + 1))


def _heading_axis(transitions: Transitions) -> Axis:
    bins = int(np.clip(len(transitions) / 40, 4, 12))
    return Axis("heading, °", np.degrees(transitions.pose[:, 2]), np.linspace(-180, 180, bins + 1))


def _vehicle_axis(transitions: Transitions) -> Axis:
    edges = np.arange(len(transitions.vehicles) + 1) - 0.5
    return Axis("vehicle", transitions.vehicle.astype(float), edges, transitions.vehicles)


def _nearest_neighbour(transitions: Transitions) -> np.ndarray:
    """Return (N, 2) forward_mm, left_mm to the nearest neighbour, NaN where none is seen."""
    apart = transitions.neighbours[..., :2]
    distance_mm = np.where(np.isfinite(apart).all(axis=-1), np.linalg.norm(apart, axis=-1), np.inf)
    return apart[np.arange(len(apart)), distance_mm.argmin(axis=1)]
