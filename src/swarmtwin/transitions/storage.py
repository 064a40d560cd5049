"""Transitions as one parquet file: a row each, with their robot, runs and vehicles in the file's metadata."""

import json
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from itertools import product
from pathlib import Path
from typing import Any, Self

import numpy as np
import pyarrow as pa
import pyarrow.parquet

from swarmtwin.files import check_regular
from swarmtwin.recordings.recording import fault
from swarmtwin.robot import DISPLACEMENT_COLUMNS, POSE_COLUMNS, VELOCITY_COLUMNS, Arena, Robot, SituationPart
from swarmtwin.transitions.transitions import SPLITS, Fields, Transitions, array_fields


def write_transitions(file: Path, transitions: Transitions, beside: Mapping[str, np.ndarray] | None = None) -> None:
    """Write transitions to `file`; those that have K neighbours get columns `neighbour_1_forward_mm` and so on.

    Velocities are written where the robot's models are given them; else they follow from the transitions before.

    Args:
        file: `.parquet`.
        transitions: N of them.
        beside: further columns (N,) by name, which `read_transitions` leaves aside.
    """
    pa.parquet.write_table(_table(transitions, transitions.runs, transitions.vehicles, beside or {}), file)


def write_parts(file: Path, parts: Iterator[Transitions], runs: Sequence[str], vehicles: Sequence[str]) -> None:
    """Write transitions as they come, each part a group of rows; one part alone gives the file of `write_transitions`.

    Args:
        file: `.parquet`.
        parts: at least one, of one robot and arena and as many neighbours, each with runs and vehicles of its own.
        runs: names of all runs, in order.
        vehicles: ids of all vehicles.
    """
    first = _table(next(parts), runs, vehicles, {})
    with pa.parquet.ParquetWriter(file, first.schema) as writer:
        writer.write_table(first)
        del first
        for part in parts:
            writer.write_table(_table(part, runs, vehicles, {}))


def read_transitions(file: Path, remedy: str) -> Transitions:
    """Read the transitions in `file`, their robot inside.

    A file of an old version has no neighbours, its earlier commands are NaN, and its arena is the robot's usual one.
    Where there are no columns of velocities, they are taken from the transitions before.

    Raises:
        UserError: the file is missing or damaged; `remedy` is what to do about it.
    """
    with readable(file, remedy):
        table = pa.parquet.read_table(file)
        header = StoredHeader.of(table.schema)
        return header.transitions({name: header.field(table, name) for name in array_fields() if header.holds(name)})


@contextmanager
def readable(file: Path, remedy: str) -> Iterator[None]:
    """Turn what goes wrong with a file of transitions within the block into one error that says what to do."""
    check_regular(file)
    try:
        yield
    except (pa.ArrowException, OSError, ValueError, KeyError) as error:
        what = f"no transitions can be read ({str(error).splitlines()[0]})"
        raise fault(file, what, remedy) from None


@dataclass(frozen=True)
class StoredHeader:
    """What a file of transitions says of them as a whole.

    Attributes:
        robot: the robot they were measured on.
        arena_mm: where its vehicles could move.
        runs: names of the runs.
        vehicles: ids of the vehicles.
        columns: the file's.
    """

    robot: Robot
    arena_mm: Arena
    runs: tuple[str, ...]
    vehicles: tuple[str, ...]
    columns: tuple[str, ...]

    @classmethod
    def of(cls, schema: pa.Schema) -> Self:
        """Take it from the schema of a file.

        Raises:
            KeyError: the file is none of transitions.
            ValueError: likewise.
        """
        metadata = {name.decode(): value for name, value in (schema.metadata or {}).items()}
        robot = Robot.model_validate_json(metadata["robot"])
        return cls(
            robot=robot,
            arena_mm=Arena.model_validate_json(arena) if (arena := metadata.get("arena_mm")) else robot.arena_mm,
            runs=tuple(json.loads(metadata["runs"])),
            vehicles=tuple(json.loads(metadata["vehicles"])),
            columns=tuple(schema.names),
        )

    def columns_of(self, name: str) -> tuple[str, ...]:
        """Return the columns that an array of `Transitions` is made of."""
        most = sum(column.startswith("neighbour_") for column in self.columns) // len(DISPLACEMENT_COLUMNS)
        parts: Mapping[Any, tuple[str, ...]] = situation_columns(self.robot, most)
        return DISPLACEMENT_COLUMNS if name == "displacement" else parts.get(name, (name,))

    def holds(self, name: str) -> bool:
        """Whether an array is read from the file; velocities may follow from the other arrays instead."""
        return name != "velocity" or bool(set(self.columns_of(name)) & set(self.columns))

    def field(self, table: pa.Table, name: str) -> np.ndarray:
        """Return an array of `Transitions` from rows of the file.

        Raises:
            KeyError: a column is missing, or holds a run or vehicle that the file does not name.
        """
        columns = self.columns_of(name)
        if name in ("run", "vehicle", "split"):
            names = {"run": self.runs, "vehicle": self.vehicles, "split": SPLITS}[name]
            index = _index(table, name, names)
            return index.astype(np.int8) if name == "split" else index
        if name in ("time_s", "duration_s"):
            return table.column(name).to_numpy().copy()
        if name == "neighbours":
            most = len(columns) // len(DISPLACEMENT_COLUMNS)
            return _stacked(table, columns).reshape(len(table), most, 3) if most else np.empty((len(table), 0, 3))
        if name == "earlier_command" and not set(columns) & set(self.columns):
            return np.full((len(table), len(columns)), np.nan)
        return _stacked(table, columns)

    def transitions(self, fields: Fields) -> Transitions:
        """Return transitions that consist of these arrays."""
        arrays: dict[str, Any] = dict(fields)
        return Transitions(robot=self.robot, arena_mm=self.arena_mm, runs=self.runs, vehicles=self.vehicles, **arrays)


def situation_columns(robot: Robot, neighbours: int) -> dict[SituationPart, tuple[str, ...]]:
    """Return the columns of each part of a situation in a table, with so many other vehicles."""
    commands = robot.command_columns
    others = tuple(f"neighbour_{n}_{name}" for n, name in product(range(1, neighbours + 1), DISPLACEMENT_COLUMNS))
    return {
        "command": commands,
        "previous_command": tuple(f"previous_{name}" for name in commands),
        "earlier_command": tuple(f"earlier_{name}" for name in commands),
        "pose": POSE_COLUMNS,
        "velocity": VELOCITY_COLUMNS,
        "elapsed_s": ("time_s",),
        "duration_s": ("duration_s",),
        "neighbours": others,
    }


def _table(
    transitions: Transitions, runs: Sequence[str], vehicles: Sequence[str], beside: Mapping[str, np.ndarray]
) -> pa.Table:
    """Return transitions as a table whose metadata name `runs` and `vehicles`."""
    most = transitions.neighbours.shape[1]
    names = situation_columns(transitions.robot, most)
    neighbours = transitions.neighbours.reshape(len(transitions), 3 * most)
    velocity = zip(names["velocity"], transitions.velocity.T, strict=True)
    columns: dict[str, Any] = {
        "run": _named(transitions.run, transitions.runs),
        "vehicle": _named(transitions.vehicle, transitions.vehicles),
        "split": _named(transitions.split, SPLITS),
        "time_s": transitions.time_s,
        "duration_s": transitions.duration_s,
        **dict(zip(names["command"], transitions.command.T, strict=True)),
        **dict(zip(names["previous_command"], transitions.previous_command.T, strict=True)),
        **dict(zip(names["earlier_command"], transitions.earlier_command.T, strict=True)),
        **dict(zip(names["pose"], transitions.pose.T, strict=True)),
        **dict(zip(DISPLACEMENT_COLUMNS, transitions.displacement.T, strict=True)),
        **(dict(velocity) if "velocity" in transitions.robot.situation else {}),
        **dict(zip(names["neighbours"], neighbours.T, strict=True)),
        **beside,
    }
    metadata = {
        "robot": transitions.robot.model_dump_json(),
        "arena_mm": transitions.arena_mm.model_dump_json(),
        "runs": json.dumps(runs),
        "vehicles": json.dumps(vehicles),
    }
    return pa.table(columns, metadata=metadata)


def _named(index: np.ndarray, names: tuple[str, ...]) -> pa.DictionaryArray:
    return pa.DictionaryArray.from_arrays(pa.array(index.astype(np.int32)), pa.array(names, pa.string()))


def _index(table: pa.Table, name: str, names: tuple[str, ...]) -> np.ndarray:
    """Return (N,) the position in `names` of each text in a column."""
    encoded = table.column(name).cast(pa.string()).combine_chunks().dictionary_encode()
    positions = {text: index for index, text in enumerate(names)}
    translated = np.array([positions[text] for text in encoded.dictionary.to_pylist()], dtype=np.int64)
    return translated[encoded.indices.to_numpy()]


def _stacked(table: pa.Table, names: tuple[str, ...]) -> np.ndarray:
    return np.column_stack([table.column(name).to_numpy() for name in names])
