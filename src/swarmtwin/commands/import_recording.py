"""`swarmtwin import`: foreign data become a recording."""

from pathlib import Path
from typing import Annotated, Any, Self

import numpy as np
from pydantic import Field, model_validator
from rich.console import Console
from rich.table import Table

from swarmtwin.files import new_folder
from swarmtwin.recordings.importer import importer_config
from swarmtwin.recordings.reading import read_recording
from swarmtwin.recordings.recording import SENT_FILE, Recording
from swarmtwin.recordings.sent_commands import write_sent_commands
from swarmtwin.recordings.writing import FileFormat, write_recording
from swarmtwin.robot import Robot, StrictModel
from swarmtwin.transitions import Counts, Transitions, from_recording
from swarmtwin.transitions.inputs import Vehicles


class Options(StrictModel):
    """Options of `swarmtwin import`; their defaults stand in conf/import.yaml."""

    robot: Robot
    source: dict[str, Any]
    path: Path
    vehicles: Vehicles
    run_s: Annotated[float, Field(le=86_400.0)]  # a day: more is a mistake in the unit
    output: Path
    format: FileFormat | None
    overwrite: bool

    @model_validator(mode="after")
    def _runs_hold_transitions(self) -> Self:
        shortest_s = 2 * self.robot.period_s
        if self.run_s < shortest_s:
            raise ValueError(f"run_s {self.run_s:g} is too short: give at least two periods, {shortest_s:g}")
        return self


def run(options: Options) -> dict[str, Any]:
    """Import, check that the recording can be read, show what it holds, and return how much.

    Raises:
        UserError: the source is unknown, its data are missing or damaged, or the output is taken.
    """
    importer = importer_config(options.source, "source")
    config = options.model_dump(mode="json")
    with new_folder(options.output, "import", config, options.overwrite) as folder:
        header, tracks = importer.read(options.path, options.robot, options.vehicles, options.run_s)
        write_recording(folder, options.robot, header, tracks, options.format)
        if sent := importer.sent(options.path, options.robot, options.vehicles):
            write_sent_commands(folder / SENT_FILE, options.robot, sent)
        recording = read_recording(folder, options.robot)
        transitions, counts = from_recording(recording)
    Console().print(_summary(recording, transitions, counts))
    return {"runs": len(recording.runs), "transitions": counts.kept, "output": str(options.output)}


def _summary(recording: Recording, transitions: Transitions, counts: Counts) -> Table:
    table = Table(
        "vehicle", "runs", "rows", "transitions", title=f"{recording.robot.title}: {len(recording.runs)} runs"
    )
    for index, vehicle in enumerate(recording.vehicles):
        tracks = [track for track in recording.tracks if track.vehicle == vehicle]
        usable = int(np.sum(transitions.vehicle == index))
        table.add_row(vehicle, str(len(tracks)), str(sum(map(len, tracks))), str(usable))
    table.add_row("all", str(len(recording.tracks)), str(counts.rows), str(counts.kept), style="bold")
    for column in table.columns[1:]:
        column.justify = "right"
    return table
