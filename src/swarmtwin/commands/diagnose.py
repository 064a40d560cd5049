"""`swarmtwin diagnose`: what a simulation gets wrong on measured data, why, and what an extended simulation gains."""

from pathlib import Path
from typing import Annotated, Any

from pydantic import Field
from rich import box
from rich.console import Console
from rich.table import Table

from swarmtwin.diagnosis.diagnose import diagnose
from swarmtwin.diagnosis.diagnosis_folder import EXTENDED, extension_provenance, save_diagnosis
from swarmtwin.diagnosis.reference_inputs import reference_for
from swarmtwin.diagnosis.report.page import draw_diagnosis
from swarmtwin.diagnosis.report.sentences import verdict_words
from swarmtwin.diagnosis.result import DiagnosedSession, DiagnosisResult, Gain
from swarmtwin.diagnosis.settings import DiagnosisSettings
from swarmtwin.dynamics.evaluation import one_step_errors
from swarmtwin.dynamics.provenance import Provenance
from swarmtwin.files import check_output, new_folder, output_folder
from swarmtwin.learning.device import Device, one_thread
from swarmtwin.learning.progress_bars import stage_bar
from swarmtwin.recordings.joining import joined
from swarmtwin.robot import Robot, Seed, SituationPart, StrictModel
from swarmtwin.studies.tracked_inputs import model_input, recording_input
from swarmtwin.tracking import registry
from swarmtwin.tracking.challengers import challenge_by_errors
from swarmtwin.tracking.gate import Errors
from swarmtwin.tracking.model_source import model_folder
from swarmtwin.tracking.runs import TrackedRun, tracked_run
from swarmtwin.transitions.inputs import Recordings, Vehicles, read_several, read_vehicles


class Options(StrictModel):
    """Options of `swarmtwin diagnose`; their defaults stand in conf/diagnose.yaml."""

    robot: Robot
    reference: Recordings
    simulation: str | None
    reference_vehicles: Vehicles
    measured: Path
    vehicles: Vehicles
    situation: tuple[SituationPart, ...] | None
    diagnosis: DiagnosisSettings
    device: Device
    seed: Seed
    register_model: Annotated[bool, Field(alias="register")]
    pictures: bool
    output: Path | None
    overwrite: bool


def run(options: Options) -> dict[str, Any]:
    """Diagnose, save the diagnosis, the extended simulation and the report, track and register; return the verdict.

    Raises:
        UserError: an unusable reference or simulation, an unusable measured recording, or the output is taken.
    """
    folder = model_folder(options.simulation) if options.simulation else None
    inputs = [path for path in (*(options.reference or ()), folder, options.measured) if path]
    name = f"{options.robot.name}-{options.measured.resolve().name}"
    output = output_folder(options.output, "diagnose", name)
    settings = options.model_dump(mode="json", by_alias=True)
    check_output(output, "diagnose", options.overwrite, inputs)
    measured = read_vehicles(options.measured, options.robot, options.vehicles)
    given = [recording_input(options.measured, "measured", measured)]
    reference_recording = None
    if options.reference:
        parts = read_several(options.reference, options.robot, options.reference_vehicles)
        driven = {path: part for path, part in parts.items() if part.tracks}
        reference_recording = joined(driven)
        given += [recording_input(path, "reference", part) for path, part in driven.items()]
    if folder:
        given.append(model_input(folder, "simulation"))
    with (
        new_folder(output, "diagnose", settings, options.overwrite, inputs=inputs) as inside,
        tracked_run("diagnosis", name, settings, given, options.seed) as tracked,
    ):
        with stage_bar("diagnosis") as report, one_thread():
            report("learning the reference", 0, 1)
            reference, learned = reference_for(
                measured,
                options.robot,
                reference=reference_recording,
                name=f"the reference {' and '.join(map(str, options.reference or ()))}",
                folder=folder,
                situation=options.situation,
                settings=options.diagnosis,
                device=options.device,
                seed=options.seed,
            )
            diagnosed = diagnose(reference, measured, options.seed, report)
        about = options.model_dump(mode="json", exclude={"robot"})
        recorded = options.measured.resolve().name
        provenance = extension_provenance(diagnosed, measured, recorded, learned, about, options.seed)
        save_diagnosis(inside, diagnosed, provenance)
        if options.pictures:
            draw_diagnosis(inside, inside)
        _track(tracked, inside, diagnosed)
        of_reference = reference_recording.warnings if reference_recording else ()
        tracked.warnings(tuple(dict.fromkeys((*measured.warnings, *of_reference))))
        registered = _registered(options, tracked, inside, diagnosed)
    Console().print(table(diagnosed.result))
    Console().print(verdict_words(diagnosed.result), highlight=False, markup=False, soft_wrap=True)
    page = "report.html" if options.pictures else "diagnosis.json"
    Console().print(f"{output / page}: {registered}", highlight=False, soft_wrap=True)
    return {
        "verdict": diagnosed.result.verdict,
        "causes": ", ".join(cause.name for cause in diagnosed.result.causes),
        **{f"{when}_position_mm": getattr(diagnosed.result.gain.position_mm, when) for when in ("before", "after")},
        "output": str(output),
    }


def _track(tracked: TrackedRun, output: Path, diagnosed: DiagnosedSession) -> None:
    diagnosis = diagnosed.result
    tracked.metrics(
        {
            f"{when}_{name}": getattr(gain, when)
            for name, gain in _gains(diagnosis).items()
            for when in ("before", "after")
        }
    )
    for cause in diagnosis.causes:
        tracked.metrics({f"{cause.name}_{name}": one.value for name, one in cause.parameters.items()})
    tracked.note(verdict_words(diagnosis))
    tracked.tag("verdict", diagnosis.verdict)
    tracked.tag("causes", ", ".join(cause.name for cause in diagnosis.causes) or "none")
    tracked.folder(output, "diagnosis")


def _registered(options: Options, tracked: TrackedRun, output: Path, diagnosed: DiagnosedSession) -> str:
    if diagnosed.extended is None:
        return "the simulation stands as it is"
    if diagnosed.result.not_confirmed:
        return f"the simulation stands as it is, nothing is registered: {diagnosed.result.not_confirmed}"
    if diagnosed.result.not_registered:
        return f"extended simulation not registered: {diagnosed.result.not_registered}"
    if not options.register_model:
        return "extended simulation not registered"
    folder = output / EXTENDED
    kept = tracked.model(folder, "dynamics")
    provenance = Provenance.read(folder)
    causes = ", ".join(cause.name for cause in diagnosed.result.causes) or "learned residual"
    tags = {**provenance.tags("extended"), "causes": causes}
    version = registry.register(f"{options.robot.name}-dynamics", folder, kept, tracked.run_id, tags)
    held_out = diagnosed.transitions.where(diagnosed.held_out)
    errors = Errors.by_run(one_step_errors(diagnosed.extended, held_out), held_out.run)
    return f"extended simulation {challenge_by_errors(tracked, version, errors, held_out.digest())}"


def _with_extension(gain: Gain) -> str:
    return f" → {gain.after:.2f} (95 %: {gain.change_words})"


def _gains(diagnosis: DiagnosisResult) -> dict[str, Gain]:
    gain = diagnosis.gain
    names = ("position_mm", "orientation_deg", "ten_periods_mm", "open_loop_mm")
    windows = {f"open_loop_{one.window_s:g}s_mm": one for one in gain.open_loop_windows}
    return {name: one for name in names if (one := getattr(gain, name))} | windows


def table(diagnosis: DiagnosisResult) -> Table:
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
        f"{name} {gain.before:.2f}{'' if diagnosis.extension == 'none' else _with_extension(gain)}"
        for name, gain in _gains(diagnosis).items()
    )
    depends = ", ".join(diagnosis.depends_on) or "nothing"
    before = "" if diagnosis.extension == "none" else "before the extension, "
    shown.caption = f"{before}the residual depends on: {depends}\non held-out runs\n{gains}"
    return shown
