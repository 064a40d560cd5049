"""Where commands take their measured data from: folders that `prepare` made, or recordings."""

from collections.abc import Sequence
from pathlib import Path
from typing import Annotated, Any

from pydantic import BeforeValidator, Field

from swarmtwin.errors import UserError, near_miss
from swarmtwin.recordings.reading import read_recording
from swarmtwin.recordings.recording import Recording
from swarmtwin.robot import Robot
from swarmtwin.transitions import (
    Preparation,
    SplitOptions,
    Transitions,
    from_recording,
    load_preparation,
    load_transitions,
    split_by_run,
)
from swarmtwin.transitions.preparation import describe


def as_texts(value: Any) -> Any:
    """Turn one id or several, as YAML reads them, into texts: 1 → ("1",)."""
    if isinstance(value, str | int):
        value = [value]
    return [str(item) for item in value] if isinstance(value, list | tuple) else value


Vehicles = Annotated[Annotated[tuple[str, ...], Field(min_length=1)] | None, BeforeValidator(as_texts)]
"""Ids of vehicles as typed in a command, where they look like numbers: vehicles=1, vehicles=[1,2]."""

Recordings = Annotated[Annotated[tuple[Path, ...], Field(min_length=1)] | None, BeforeValidator(as_texts)]
"""Folders of one or several recordings: reference=clean, reference=[clean-1,clean-2]."""


def training_transitions(
    robot: Robot, transitions: Path | None, recording: Path | None, vehicles: Vehicles, split: SplitOptions
) -> tuple[Transitions, Preparation, Path]:
    """Return transitions with their splits, how they came about, and the folder they come from.

    A recording is prepared on the way, by `split`; prepared transitions are split already.

    Raises:
        UserError: both or neither are there, the data are of another robot, or at fault.
    """
    folder = training_folder(robot, transitions, recording, vehicles)
    if recording:
        return *_prepared(read_vehicles(folder, robot, vehicles), folder.resolve().name, split), folder
    return *prepared_transitions(folder, robot), folder


def training_folder(robot: Robot, transitions: Path | None, recording: Path | None, vehicles: Vehicles) -> Path:
    """Return the recording or the prepared transitions to learn from: those given, or the pipeline's.

    Raises:
        UserError: both are given, or neither and the pipeline has not run.
    """
    if transitions and recording:
        raise UserError("give transitions=... or recording=..., not both")
    if recording:
        return recording
    if vehicles is not None:
        raise UserError("vehicles=... chooses from a recording: give recording=... as well")
    folder = transitions or Path("artifacts/transitions") / robot.name
    if transitions is None and not folder.is_dir():
        raise UserError(f"no transitions in {folder}: run `dvc repro` first, or give recording=... or transitions=...")
    return folder


def prepared_transitions(folder: Path, robot: Robot) -> tuple[Transitions, Preparation]:
    """Read transitions with their splits, real or synthetic, and how they came about.

    Raises:
        UserError: there are none, they are damaged, or of another robot.
    """
    preparation = preparation_of(folder, robot)
    return load_transitions(folder), preparation


def preparation_of(folder: Path, robot: Robot) -> Preparation:
    """Read how transitions of `robot` came about.

    Raises:
        UserError: there are none, or they are of another robot.
    """
    preparation = load_preparation(folder)
    if preparation.robot != robot.name:
        raise UserError(f"{folder} holds transitions of robot {preparation.robot!r}: add robot={preparation.robot}")
    return preparation


def read_vehicles(folder: Path, robot: Robot, vehicles: Vehicles) -> Recording:
    """Read a recording, or the part of it that some vehicles drove.

    Raises:
        UserError: the recording is at fault, or a vehicle does not occur in it.
    """
    return read_several([folder], robot, vehicles)[folder]


def read_several(folders: Sequence[Path], robot: Robot, vehicles: Vehicles) -> dict[Path, Recording]:
    """Read recordings, or the parts of them that some vehicles drove.

    Raises:
        UserError: a recording is at fault, or a vehicle does not occur in any.
    """
    recordings = {folder: read_recording(folder, robot) for folder in folders}
    if vehicles is None:
        return recordings
    known = sorted({vehicle for recording in recordings.values() for vehicle in recording.vehicles})
    for vehicle in vehicles:
        if vehicle not in known:
            where = ", ".join(map(str, folders))
            raise UserError(f"{where}: no vehicle {vehicle!r}: {near_miss(vehicle, known)}")
    return {
        folder: recording.where(lambda track: track.vehicle in vehicles) for folder, recording in recordings.items()
    }


def _prepared(recording: Recording, name: str, split: SplitOptions) -> tuple[Transitions, Preparation]:
    transitions, counts = from_recording(recording)
    transitions = split_by_run(transitions, split.fractions, split.seed)
    return transitions, describe(recording, name, transitions, counts, split.fractions, split.seed)
