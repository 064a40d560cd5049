"""`swarmtwin diagnose`: what a simulation gets wrong on measured data, why, and what an extended simulation gains."""

from pathlib import Path
from typing import Annotated

import numpy as np
import pandas as pd
from pydantic import Field
from rich import box
from rich.console import Console
from rich.table import Table

from swarmtwin import registry
from swarmtwin.commands.measurement import load_simulation
from swarmtwin.commands.outputs import output_folder
from swarmtwin.commands.progress import stage_bar
from swarmtwin.commands.sources import Vehicles, read_vehicles
from swarmtwin.dynamics.provenance import Provenance, SeedOutcome
from swarmtwin.dynamics.store import load_evidence, save_dynamics
from swarmtwin.errors import UserError
from swarmtwin.files import check_output, new_folder, write_text
from swarmtwin.gap.diagnosing import diagnose
from swarmtwin.gap.diagnosis import Diagnosis, Gain
from swarmtwin.gap.extended import ExtendedDynamics
from swarmtwin.gap.finding import Finding
from swarmtwin.gap.reference import Reference
from swarmtwin.gap.report import write_report
from swarmtwin.gap.separation import DRIVE_FILE
from swarmtwin.recordings.recording import Recording
from swarmtwin.robot import Robot, Seed, SituationPart, StrictModel
from swarmtwin.tracking import TrackedRun, tracked_run
from swarmtwin.trainer import one_thread
from swarmtwin.transitions import from_recording

EXTENDED = "simulation"


class Options(StrictModel):
    """Options of `swarmtwin diagnose`; their defaults stand in conf/diagnose.yaml."""

    robot: Robot
    reference: Path | None
    simulation: str | None
    reference_vehicles: Vehicles
    measured: Path
    vehicles: Vehicles
    situation: tuple[SituationPart, ...] | None
    seed: Seed
    register_model: Annotated[bool, Field(alias="register")]
    output: Path | None
    overwrite: bool


def run(options: Options) -> None:
    """Diagnose, save the diagnosis with its report and the extended simulation, track and register.

    Raises:
        UserError: neither or unusable reference or simulation, an unusable measured recording, or the output is taken.
    """
    if options.reference is None and options.simulation is None:
        raise UserError("give reference=DIR, a recording in which nothing is wrong, or simulation=FOLDER|models:/...")
    folder = registry.model_folder(options.simulation) if options.simulation else None
    inputs = [path for path in (options.reference, folder, options.measured) if path]
    name = f"{options.robot.name}-{options.measured.resolve().name}"
    output = output_folder(options.output, "diagnose", name)
    settings = options.model_dump(mode="json", by_alias=True)
    check_output(output, "diagnose", options.overwrite, inputs)
    measured = read_vehicles(options.measured, options.robot, options.vehicles)
    with tracked_run("diagnosis", name, settings, inputs, options.seed) as tracked:
        with new_folder(output, "diagnose", settings, options.overwrite, inputs=inputs) as inside:
            with stage_bar("diagnosis") as report, one_thread():
                report("learning the reference", 0, 1)
                reference, learned = _reference(options, folder, measured)
                finding = diagnose(reference, measured, options.seed, report)
            _save(inside, finding, _provenance(options, measured, finding, learned))
        _track(tracked, output, finding)
        registered = _registered(options, tracked, output, finding)
    Console().print(table(finding.diagnosis))
    Console().print(f"{output / 'report.html'}: {registered}", highlight=False, soft_wrap=True)


def _reference(options: Options, folder: Path | None, measured: Recording) -> tuple[Reference, tuple[str, ...]]:
    """Return what to compare with, and the digests of the tracks it was learned from."""
    if folder is None:
        assert options.reference is not None
        recording = read_vehicles(options.reference, options.robot, options.reference_vehicles)
        learned = tuple(track.digest() for track in recording.tracks)
        _refuse_overlap(learned, measured, f"the reference {options.reference}")
        transitions, _ = from_recording(recording)
        arena = recording.header.arena_mm
        return Reference.learn(transitions, arena, options.seed, options.situation), learned
    if options.situation is not None:
        raise UserError("situation=... is for a simulation learned from reference=DIR: a trained one has its own")
    dynamics, provenance = load_simulation(folder, options.robot)
    if isinstance(dynamics, ExtendedDynamics):
        raise UserError(
            f"{folder} is an extended simulation, as a diagnosis leaves it: diagnose the one that it extends, or learn "
            "from a recording in which nothing is wrong, reference=DIR without simulation"
        )
    _refuse_overlap(provenance.learned, measured, f"the recording that {folder} was trained on")
    if options.reference is None:
        evidence = load_evidence(folder)
        if evidence is None:
            raise UserError(
                f"{folder} holds no evidence.parquet, real transitions that it was not fitted to: train it anew on "
                "real data, or add reference=DIR, a recording in which nothing is wrong"
            )
        return Reference.of_simulation(dynamics, evidence, options.robot.arena_mm, options.seed), provenance.learned
    recording = read_vehicles(options.reference, options.robot, options.reference_vehicles)
    _refuse_overlap(tuple(track.digest() for track in recording.tracks), measured, f"the reference {options.reference}")
    transitions, _ = from_recording(provenance.unseen_part(recording))
    return (
        Reference.of_simulation(dynamics, transitions, recording.header.arena_mm, options.seed),
        provenance.learned,
    )


def _refuse_overlap(learned: tuple[str, ...], measured: Recording, what: str) -> None:
    known = set(learned)
    if shared := sorted({track.run for track in measured.tracks if track.digest() in known}):
        raise UserError(
            f"{len(shared)} measured runs, such as {shared[0]}, are also in {what}: what a simulation was learned from "
            "cannot show what it gets wrong; measure other runs"
        )


def _provenance(options: Options, measured: Recording, finding: Finding, learned: tuple[str, ...]) -> Provenance:
    """Describe where an extended simulation comes from: it has seen the reference and the fitted measured runs."""
    transitions, held_out = finding.transitions, finding.held_out
    names = [{transitions.runs[index] for index in np.unique(transitions.run[mask])} for mask in (~held_out, held_out)]
    fitted = tuple(track.digest() for track in measured.tracks if track.run in names[0])
    gain = finding.diagnosis.gain
    outcome = SeedOutcome(
        seed=options.seed,
        best_epoch=1,
        position_mm=gain.position_mm.after,
        orientation_deg=gain.orientation_deg.after,
        dead=None,
    )
    return Provenance(
        recording=options.measured.resolve().name,
        digest=measured.digest,
        source=measured.header.source,
        vehicles=finding.diagnosis.vehicles,
        runs={"train": tuple(sorted(names[0])), "validation": (), "test": tuple(sorted(names[1]))},
        learned=tuple(sorted({*learned, *fitted})),
        recipe={"diagnosis": options.model_dump(mode="json", exclude={"robot"})},
        seed=options.seed,
        seeds=(outcome,),
    )


def _save(folder: Path, finding: Finding, provenance: Provenance) -> None:
    diagnosis = finding.diagnosis
    write_text(folder / "diagnosis.json", diagnosis.model_dump_json(indent=1) + "\n")
    write_report(folder, finding)
    if finding.drive is not None:
        columns = list(finding.simulation.robot.command_columns)
        pd.DataFrame(finding.drive, columns=columns).to_csv(folder / DRIVE_FILE, index=False)
    if finding.extended is not None:
        (folder / EXTENDED).mkdir()
        save_dynamics(folder / EXTENDED, finding.extended, provenance.model_dump(mode="json"))


def _track(tracked: TrackedRun, output: Path, finding: Finding) -> None:
    diagnosis = finding.diagnosis
    tracked.metrics(
        {
            f"{when}_{name}": getattr(gain, when)
            for name, gain in _gains(diagnosis).items()
            for when in ("before", "after")
        }
    )
    for cause in diagnosis.causes:
        tracked.metrics({f"{cause.name}_{name}": one.value for name, one in cause.parameters.items()})
    tracked.tag("verdict", diagnosis.verdict)
    tracked.tag("causes", ", ".join(cause.name for cause in diagnosis.causes) or "none")
    tracked.folder(output, "diagnosis")


def _registered(options: Options, tracked: TrackedRun, output: Path, finding: Finding) -> str:
    if finding.extended is None:
        return "the simulation stands as it is"
    if not options.register_model:
        return "extended simulation not registered"
    folder = output / EXTENDED
    kept = tracked.folder(folder, "model")
    provenance = Provenance.read(folder)
    causes = ", ".join(cause.name for cause in finding.diagnosis.causes) or "learned residual"
    tags = {**provenance.tags("extended"), "causes": causes}
    version = registry.register(f"{options.robot.name}-dynamics", folder, kept, tracked.run_id, tags)
    return f"extended simulation registered as {version}, its challenger"


def _gains(diagnosis: Diagnosis) -> dict[str, Gain]:
    gain = diagnosis.gain
    return {"position_mm": gain.position_mm, "orientation_deg": gain.orientation_deg, "open_loop_mm": gain.open_loop_mm}


def table(diagnosis: Diagnosis) -> Table:
    """Return a table a person reads: the verdict, each cause with its parameters, and the gain."""
    shown = Table(
        box=box.SIMPLE_HEAD,
        padding=(0, 1, 0, 0),
        pad_edge=False,
        title=f"{diagnosis.robot}: {diagnosis.verdict.replace('_', ' ')}",
    )
    for heading in ("cause", "parameters (95 %)", "share of gap", "confidence", "rivals"):
        shown.add_column(heading)
    for cause in diagnosis.causes:
        told = "\n".join(
            f"{name} {one.value:.4g} ({one.low:.4g} to {one.high:.4g})" for name, one in cause.parameters.items()
        )
        rivals = ", ".join(cause.rivals)
        shown.add_row(cause.name, told, f"{cause.share_of_gap:.0%}", f"{cause.confidence:.0%}", rivals)
    gains = "\n".join(
        f"{name} {gain.before:.2f} → {gain.after:.2f} (95 %: {gain.low:.2f} to {gain.high:.2f} less)"
        for name, gain in _gains(diagnosis).items()
    )
    depends = ", ".join(diagnosis.depends_on) or "nothing"
    shown.caption = f"the residual depends on: {depends}\non held-out runs\n{gains}"
    return shown
