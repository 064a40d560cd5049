"""Transitions as one parquet file: a row each, with their robot, runs and vehicles in the file's metadata."""

import json
from collections.abc import Mapping
from itertools import product
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.parquet

from swarmtwin.files import check_regular
from swarmtwin.recordings.recording import fault
from swarmtwin.robot import DISPLACEMENT_COLUMNS, POSE_COLUMNS, VELOCITY_COLUMNS, Arena, Robot, SituationPart
from swarmtwin.transitions.transitions import SPLITS, Transitions


def write_transitions(file: Path, transitions: Transitions, beside: Mapping[str, np.ndarray] | None = None) -> None:
    """Write transitions to `file`; those that have K neighbours get columns `neighbour_1_forward_mm` and so on.

    Velocities are written where the robot's models are given them; else they follow from the transitions before.

    Args:
        file: `.parquet`.
        transitions: N of them.
        beside: further columns (N,) by name, which `read_transitions` leaves aside.
    """
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
        **(beside or {}),
    }
    metadata = {
        "robot": transitions.robot.model_dump_json(),
        "arena_mm": transitions.arena_mm.model_dump_json(),
        "runs": json.dumps(transitions.runs),
        "vehicles": json.dumps(transitions.vehicles),
    }
    pa.parquet.write_table(pa.table(columns, metadata=metadata), file)


def read_transitions(file: Path, remedy: str) -> Transitions:
    """Read the transitions in `file`, their robot inside.

    A file of an old version has no neighbours, its earlier commands are NaN, and its arena is the robot's usual one.
    Where there are no columns of velocities, they are taken from the transitions before.

    Raises:
        UserError: the file is missing or damaged; `remedy` is what to do about it.
    """
    check_regular(file)
    try:
        table = pa.parquet.read_table(file)
        metadata = {name.decode(): value for name, value in (table.schema.metadata or {}).items()}
        robot = Robot.model_validate_json(metadata["robot"])
        most = sum(name.startswith("neighbour_") for name in table.column_names) // len(DISPLACEMENT_COLUMNS)
        names = situation_columns(robot, most)
        return Transitions(
            robot=robot,
            arena_mm=Arena.model_validate_json(arena) if (arena := metadata.get("arena_mm")) else robot.arena_mm,
            command=_stacked(table, names["command"]),
            previous_command=_stacked(table, names["previous_command"]),
            earlier_command=_earlier_command(table, names["earlier_command"]),
            pose=_stacked(table, names["pose"]),
            displacement=_stacked(table, DISPLACEMENT_COLUMNS),
            neighbours=_neighbours(table, names["neighbours"]),
            **_velocity(table, names["velocity"]),
            time_s=table.column("time_s").to_numpy(),
            duration_s=table.column("duration_s").to_numpy(),
            run=_index(table, "run", runs := tuple(json.loads(metadata["runs"]))),
            vehicle=_index(table, "vehicle", vehicles := tuple(json.loads(metadata["vehicles"]))),
            split=_index(table, "split", SPLITS).astype(np.int8),
            runs=runs,
            vehicles=vehicles,
        )
    except (pa.ArrowException, OSError, ValueError, KeyError) as error:
        what = f"no transitions can be read ({str(error).splitlines()[0]})"
        raise fault(file, what, remedy) from None


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


def _earlier_command(table: pa.Table, columns: tuple[str, ...]) -> np.ndarray:
    """Return (N, m) the commands before the previous ones, NaN where the file has no columns for them."""
    if not set(columns) & set(table.column_names):
        return np.full((len(table), len(columns)), np.nan)
    return _stacked(table, columns)


def _velocity(table: pa.Table, columns: tuple[str, ...]) -> dict[str, np.ndarray]:
    """Return the velocities (N, 3), if the file has columns for them."""
    return {"velocity": _stacked(table, columns)} if set(columns) & set(table.column_names) else {}


def _neighbours(table: pa.Table, columns: tuple[str, ...]) -> np.ndarray:
    """Return (N, K, 3) as many neighbours as there are columns for."""
    if not columns:
        return np.empty((len(table), 0, 3))
    return _stacked(table, columns).reshape(len(table), -1, 3)
