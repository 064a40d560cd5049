"""From measured data to a cause with a name, an extended simulation and its gain, in four steps.

1. Reference and residual: what a simulation gets wrong, in units of the noise it has where nothing is wrong
   (`reference`, `noise`, `unit_spread`).
2. Dependence: what the residual depends on (`dependence`).
3. Causes: which mechanisms make the session likely, how sure their parameters are, and what they leave (`likelihood`,
   `estimation`, `posterior`, `cause_search`, `motion_noise`, `residual_analysis`).
4. Finding: causes as they are reported, gains on held-out runs, the next recording (`cause_report`, `gains`,
   `next_recording`, `result`; pictures in `report/`).
"""

from collections.abc import Sequence

import numpy as np

from swarmtwin.diagnosis.cause_report import reported_causes
from swarmtwin.diagnosis.cause_search import Progress
from swarmtwin.diagnosis.gains import Errors, gains, likelihood_gain, not_confirmed, scored_tracks
from swarmtwin.diagnosis.likelihood import LikelihoodModel
from swarmtwin.diagnosis.next_recording import next_recording
from swarmtwin.diagnosis.reference import Reference
from swarmtwin.diagnosis.residual_analysis import DependenceTests, analyse_residual, find_causes
from swarmtwin.diagnosis.result import Cause, DiagnosedSession, DiagnosisResult, Extension
from swarmtwin.recordings.recording import Recording
from swarmtwin.simulation.simulation import Simulation


def diagnose(
    reference: Reference, measured: Recording, seed: int, progress: Progress | None = None
) -> DiagnosedSession:
    """Compare a measured recording with a simulation: what is wrong, why, and what an extension gains.

    Args:
        reference: the simulation, its noise, and the settings of the diagnosis.
        measured: the recording in question; nothing but its runs is looked at.
        seed: of everything random.
        progress: called with what is being done, and how far it is.

    Raises:
        UserError: too few runs, another robot, constant commands, or commands that the reference does not cover.
    """
    settings, rng = reference.settings.verdict, np.random.default_rng(seed)

    # 1. Reference and residual
    session, believable, set_aside = reference.comparable(measured)
    held_out = session.run % settings.held_out_every == settings.held_out_every - 1
    model = LikelihoodModel.of_measured(reference, session.where(~held_out))
    reference_model = LikelihoodModel.of_reference(reference)

    # 2. Dependence
    _tell(progress, "tests")
    tests = DependenceTests(reference, model, reference_model, seed)
    dependences = tests.run(model.evaluate([]))

    # 3. Causes
    causes = find_causes(reference, model, reference_model, progress)
    _tell(progress, "what is left")
    analysis = analyse_residual(model, reference_model, causes, dependences, tests, rng)

    # 4. Finding
    simulation = Simulation(reference.base, (), session.conditions)
    extended = None
    if analysis.mechanisms or analysis.extension_residual:
        extended = Simulation(reference.base, analysis.mechanisms, session.conditions, analysis.extension_residual)
    transitions = session.transitions
    scored = transitions.where(held_out)
    tracks = scored_tracks(measured, believable, scored)
    errors = Errors.of(simulation, scored, tracks)
    extended_errors = Errors.of(extended, scored, tracks) if extended else errors
    plan, drive = next_recording(reference, model, analysis, seed)
    gain = gains(errors, extended_errors, scored.run, settings.gain_draws, np.random.default_rng(seed))
    objection = None
    if extended:
        unfitted = LikelihoodModel.of_measured(reference, session.where(held_out))
        likelihood = likelihood_gain(unfitted, extended, settings.gain_draws, np.random.default_rng(seed))
        objection = not_confirmed(gain, likelihood)
    named = reported_causes(model, analysis, rng)
    result = DiagnosisResult(
        verdict="unexplained" if objection else analysis.verdict,
        causes=() if objection else named,
        depends_on=tuple(test.part for test in analysis.before if test.found),
        gain=gain,
        next_recording=plan,
        left_over=analysis.left_over,
        tests=tuple(analysis.before),
        robot=reference.robot.name,
        vehicles=tuple(transitions.vehicles[index] for index in np.unique(transitions.vehicle)),
        runs={"fitted": model.session.runs, "held_out": len(np.unique(scored.run))},
        transitions={"used": len(session), "set_aside": set_aside},
        extension=_extension(extended),
        not_confirmed=_with_names(objection, named) if objection else None,
        seed=seed,
    )
    whole = LikelihoodModel(reference.base, reference.noise, session, settings=reference.settings)
    residual = whole.evaluate([]).residual
    return DiagnosedSession(
        result=result,
        simulation=simulation,
        extended=extended,
        transitions=transitions,
        held_out=held_out,
        residual_before=residual,
        residual_after=_residual_of(extended, whole) if extended else residual,
        runs_before=errors.open_loop,
        runs_after=extended_errors.open_loop,
        next_drive=drive,
    )


def _with_names(objection: str, causes: Sequence[Cause]) -> str:
    """Say what it was that held-out runs do not confirm, and why."""
    fitted = " and ".join(cause.name.replace("_", " ") for cause in causes) or "the extension"
    return f"held-out runs do not confirm {fitted}: {objection}"


def _tell(progress: Progress | None, stage: str) -> None:
    if progress:
        progress(stage, 0, 1)


def _extension(extended: Simulation | None) -> Extension:
    if extended is None:
        return "none"
    if extended.residual is None:
        return "mechanisms"
    return "mechanisms_and_learned_residual" if extended.mechanisms else "learned_residual"


def _residual_of(extended: Simulation, model: LikelihoodModel) -> np.ndarray:
    """Return (N, 3) the standardised residuals of an extended simulation."""
    if extended.residual is None:
        return model.evaluate(extended.mechanisms).residual
    twist = model.predictor.most_likely_twist(extended.mechanisms, extended.residual)
    whitened: np.ndarray = model.whitener(model.session.residual_of(twist)).numpy()
    return whitened
