"""`swarmtwin record`: stand-in robots drive; a recording results."""

from pathlib import Path
from typing import Annotated, Any, Literal

from pydantic import BeforeValidator, Field
from rich.console import Console
from rich.table import Table

from swarmtwin.errors import UserError
from swarmtwin.files import new_folder
from swarmtwin.markers import vehicle_ids
from swarmtwin.recordings.exact_means import write_exact_means
from swarmtwin.recordings.recording import Recording
from swarmtwin.recordings.writing import FileFormat, write_recording
from swarmtwin.robot import Robot, StrictModel
from swarmtwin.standin.character import CharacterName
from swarmtwin.standin.drive_commands import CommandMode
from swarmtwin.standin.effects import parse_effects
from swarmtwin.standin.rigid_body.driving import drive_rigid_session
from swarmtwin.standin.session import StandInSession, drive_session, require_stand_in
from swarmtwin.studies.stand_in_film import write_film
from swarmtwin.studies.stand_in_recording import check_size, exact_means_of, read_drive, record
from swarmtwin.transitions import Counts, from_recording
from swarmtwin.transitions.inputs import as_texts


class Options(StrictModel):
    """Options of `swarmtwin record`; their defaults stand in conf/record.yaml."""

    robot: Robot
    engine: Literal["formulas", "rigid_body"]
    vehicle: Annotated[tuple[str, ...], BeforeValidator(as_texts), Field(min_length=1)]
    runs: Annotated[int, Field(ge=1)]
    steps: Annotated[int, Field(ge=1)]
    transitions: Annotated[int, Field(ge=1)] | None
    seed: Annotated[int, Field(ge=0)]
    effects: tuple[Any, ...]
    character: CharacterName
    commands: CommandMode
    drive: Path | None
    lost_poses: Annotated[float, Field(ge=0, lt=1)]
    film: Annotated[int, Field(ge=1, le=120)] | None
    format: FileFormat | None
    output: Path
    overwrite: bool


def run(options: Options) -> dict[str, Any]:
    """Record, show what the recording holds, and return how much. Nothing in it tells which effects were on, if any.

    Raises:
        UserError: the robot has no stand-in in this engine, the engine is not installed, an effect or the drive makes
            no sense, or the output is taken.
    """
    drive = drive_rigid_session if options.engine == "rigid_body" else drive_session
    session = plan_session(options)
    config = options.model_dump(mode="json", exclude={"effects"})
    with new_folder(options.output, "record", config, options.overwrite) as folder:
        footage, recording = record(session, options.transitions, drive=drive)
        write_recording(folder, options.robot, recording.header, recording.tracks, options.format)
        if options.engine == "formulas":
            write_exact_means(folder, exact_means_of(footage, recording))
        if options.film is not None:
            write_film(folder, footage, options.film)
        _, counts = from_recording(recording)
    Console().print(_summary(options.output, recording, counts))
    return {"runs": len(recording.runs), "transitions": counts.kept, "output": str(options.output)}


def plan_session(options: Options) -> StandInSession:
    """Return the session that the options ask for.

    Raises:
        UserError: the robot has no stand-in, an effect or the drive makes no sense for it, or the recording would be
            too long.
    """
    require_stand_in(options.robot)
    if twice := sorted({vehicle for vehicle in options.vehicle if options.vehicle.count(vehicle) > 1}):
        raise UserError(f"vehicle {twice[0]!r} is named twice: give each id once")
    if options.transitions and len(options.vehicle) > 1:
        raise UserError("transitions=... cuts the runs of one vehicle: give one vehicle, or runs=... instead")
    runs = options.runs
    if options.transitions:
        runs = -(-options.transitions // options.steps)
    check_size(runs, options.steps, len(options.vehicle))
    if options.film is not None:
        vehicle_ids(options.robot, options.vehicle)
        if runs > 1:
            raise UserError("film=... shows one run: say runs=1 and as many steps as the film is to last")
    return StandInSession(
        robot=options.robot,
        vehicles=options.vehicle,
        runs=runs,
        steps=options.steps,
        seed=options.seed,
        effects=parse_effects(options.effects, options.robot, len(options.vehicle)),
        command_mode=options.commands,
        drive=None if options.drive is None else read_drive(options.drive, options.robot),
        lost_poses=options.lost_poses,
        character=options.character,
        planned_runs=runs,
    )


def _summary(output: Path, recording: Recording, counts: Counts) -> Table:
    table = Table("", "", title=f"{output} ({recording.header.source})", show_header=False)
    table.add_row("vehicles", ", ".join(recording.vehicles))
    table.add_row("runs", str(len(recording.runs)))
    table.add_row("rows", str(counts.rows))
    table.add_row("usable transitions", str(counts.kept))
    for reason, count in counts.dropped.items():
        table.add_row(f"  not usable: {reason}", str(count))
    return table
