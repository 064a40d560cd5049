"""From measured data to a cause with a name, an extended simulation and its gain, in four steps.

1. Reference and residual: what a simulation gets wrong, in units of the noise it has where nothing is wrong
   (`compared_runs`, `reference`, `own_answers`, `reference_inputs`, `noise`, `discrepancy`, `unit_spread`,
   `unlike_units`, `own_units`, `reference_errors`; `session_prediction` runs the simulation along a session,
   `quick_dynamics` nearly so in less time).
2. Dependence: what the residual depends on (`session_dependence`, `dependence`, `flexible_residual`).
3. Causes: which sets of mechanisms make the session likely, with what nobody knows exactly integrated out
   (`likelihood`, `random_effects`, `lost_commands`, `screening`, `estimation` with `estimated_set`, `cause_search`),
   and what the best of them leaves (`explanation`, `left_over`, `varying_causes`, `gain_by_chance`, `error_history`,
   `beyond_reference`, `motion_noise_change`).
4. Finding: the extended simulation and its gains on held-out runs, causes as they are reported and the leading sets,
   the smallest effects that the session would have shown, the next recording (`extension`, `gains`,
   `open_loop_pieces`, `cause_report`, `detection_limits` with `sized_causes` and `random_limits`, `next_recording`,
   `result`; pictures in `report/`).
"""

from collections.abc import Iterable, Sequence

import numpy as np

from swarmtwin.diagnosis.cause_report import leading_sets, likeliest_causes, reported_causes
from swarmtwin.diagnosis.cause_search import CausePosterior, CauseSearch
from swarmtwin.diagnosis.compared_runs import compared
from swarmtwin.diagnosis.detection_limits import detection_limits
from swarmtwin.diagnosis.estimation import Progress
from swarmtwin.diagnosis.explanation import Explanation, explanation, left_by_nothing
from swarmtwin.diagnosis.extension import HeldOutRuns
from swarmtwin.diagnosis.likelihood import SessionLikelihood
from swarmtwin.diagnosis.next_recording import next_recording
from swarmtwin.diagnosis.own_units import unit_differences
from swarmtwin.diagnosis.reference import Reference
from swarmtwin.diagnosis.reference_errors import ReferenceErrors
from swarmtwin.diagnosis.result import Cause, DiagnosedSession, DiagnosisResult, Extension
from swarmtwin.diagnosis.screening import sought_kinds
from swarmtwin.diagnosis.session_dependence import DependenceTests
from swarmtwin.recordings.recording import Recording
from swarmtwin.simulation.simulation import Simulation


def diagnose(
    reference: Reference, measured: Recording, seed: int, progress: Progress | None = None
) -> DiagnosedSession:
    """Compare a measured recording with a simulation: what is wrong, why, and what an extension gains.

    Args:
        reference: the simulation, its noise, and the settings of the diagnosis.
        measured: the recording in question; nothing but its runs is looked at: see `compared_runs`.
        seed: of everything random.
        progress: called with what is being done, and how far it is.

    Raises:
        UserError: too few runs, another robot, constant commands, or commands that the reference does not cover.
    """
    rng = np.random.default_rng(seed)

    # 1. Reference and residual
    measured, left_out = compared(measured, reference.settings.reference.most_measured)
    session, believable, set_aside = reference.comparable(measured)
    runs = HeldOutRuns(reference, session, measured, believable, seed)
    held_out = runs.rows
    model = reference.likelihood_of(session.where(~held_out))

    # 3. Causes
    own = errors_of(reference)
    found = find_causes(reference, model, own, progress)
    explained = explanation(model, found, own)

    # 4. Finding, and 2. dependence: what is noise is known beside the causes alone
    _tell(progress, "what is left")
    judged = runs.judge(explained)
    if judged.objection and explained.may_be_chance:
        nothing = left_by_nothing(model, found, own)
        if nothing.verdict == "no_gap":  # what these causes gain was the fitted runs' own
            explained, judged = nothing, runs.judge(nothing)
    tests = DependenceTests(reference, model, seed)
    dependences = tests.run(model, model.evaluate([]), explained.model)
    extended, objection, unfitted = judged.extended, judged.objection, runs.unfitted
    parts = ((~held_out, explained.model), (held_out, unfitted.explained_by(explained.best.mechanisms)))
    left = [part.by_usual_noise(_errors_shown(part, explained)) for _, part in parts]
    explained_left = [_residual_of(extended, part) for _, part in parts] if extended else left
    after = tests.of_extension(parts[1][1], extended, explained_left[1]) if extended and not objection else []
    likeliest = likeliest_causes(explained, rng)
    named = reported_causes(explained, likeliest)
    limits = detection_limits(explained, unfitted)
    plan, drive = next_recording(explained, limits, seed)
    result = DiagnosisResult(
        verdict="unexplained" if objection else explained.verdict,
        causes=causes_off_clock(explained, named) if objection else named,
        depends_on=tuple(test.part for test in dependences if test.found) if explained.verdict != "no_gap" else (),
        gain=judged.gain,
        next_recording=None if objection else plan,
        left_over=tuple(test.part for test in after if test.found),
        tests=tuple(dependences),
        robot=reference.robot.name,
        vehicles=tuple(session.transitions.vehicles[index] for index in np.unique(session.transitions.vehicle)),
        runs={"fitted": model.session.runs, "held_out": len(np.unique(runs.scored.run))},
        transitions={"used": len(session), "set_aside": set_aside} | ({"left_out": left_out} if left_out else {}),
        extension=_extension(extended),
        not_confirmed=_with_names(objection, named) if objection else None,
        not_registered=None if objection else judged.not_shown,
        units=unit_differences(explained.model, () if objection else explained.mechanisms),
        unlike_in_reference=dict(reference.unlike),
        detection_limits=tuple(one.limit for one in limits),
        posterior=leading_sets(explained.posterior, reference.settings.search.reported_sets),
        likeliest=() if explained.verdict == "no_gap" else likeliest,
        doubts=measured.warnings,
        seed=seed,
    )
    rows = [one for one, _ in parts]
    return DiagnosedSession(
        result=result,
        simulation=runs.simulation,
        extended=extended,
        transitions=session.transitions,
        held_out=held_out,
        residual_before=_together(zip(rows, left, strict=True)),
        residual_after=_together(zip(rows, explained_left, strict=True)),
        runs_before=runs.errors.open_loop,
        runs_after=judged.errors.open_loop,
        next_drive=None if objection else drive,
    )


def find_causes(
    reference: Reference, model: SessionLikelihood, own: ReferenceErrors, progress: Progress | None
) -> CausePosterior:
    """Search for the causes; in a long session in a part of its runs, their values are then estimated in all of it."""
    settings = reference.settings.search
    searched = model.thinned(settings.most_transitions)
    screened = searched.thinned(settings.most_screened)
    return CauseSearch(searched, sought_kinds(model), progress, own, screened).run()


def errors_of(reference: Reference) -> ReferenceErrors:
    """Return what the reference's own errors show; of a long one so many transitions as are searched of a session."""
    most = reference.settings.search.most_transitions
    return ReferenceErrors(lambda: reference.own_likelihood(most), are_gap=reference.discrepancy is None)


def causes_off_clock(explained: Explanation, named: Sequence[Cause]) -> tuple[Cause, ...]:
    """Return the causes that the clock itself shows, whatever an extension by them is worth."""
    shown = {one.name for one in explained.mechanisms if explained.model.read_off_clock(type(one))}
    return tuple(cause for cause in named if cause.name in shown)


def _with_names(objection: str, causes: Sequence[Cause]) -> str:
    """Say what it was that held-out runs do not confirm, and why."""
    fitted = " and ".join(cause.name.replace("_", " ") for cause in causes) or "the extension"
    return f"held-out runs do not confirm {fitted}: {objection}"


def _together(parts: Iterable[tuple[np.ndarray, np.ndarray]]) -> np.ndarray:
    """Put values (n, 3) of the transitions that masks (N,) choose into one array (N, 3)."""
    chosen = list(parts)
    whole = np.empty((len(chosen[0][0]), 3))
    for rows, values in chosen:
        whole[rows] = values
    return whole


def _tell(progress: Progress | None, stage: str) -> None:
    if progress:
        progress(stage, 0, 1)


def _extension(extended: Simulation | None) -> Extension:
    if extended is None:
        return "none"
    if extended.residual is None:
        return "mechanisms"
    return "mechanisms_and_learned_residual" if extended.mechanisms else "learned_residual"


def _errors_shown(model: SessionLikelihood, explained: Explanation) -> np.ndarray:
    """Return the errors (N, 3) of the simulation; without a gap, less what units and its uncertainty explain."""
    errors = model.errors(())
    return errors - model.evaluate([]).effect_errors if explained.verdict == "no_gap" else errors


def _residual_of(extended: Simulation, model: SessionLikelihood) -> np.ndarray:
    """Return (N, 3) the standardised residuals of an extended simulation."""
    if extended.residual is None:
        return model.by_usual_noise(model.errors_left(extended.mechanisms))
    twist = model.predictor.most_likely_twist(extended.mechanisms, extended.residual)
    return model.by_usual_noise(model.errors_of(twist))
