"""Diagnoses one case, and compares what is said with what only the stand-in knows."""

import math
import time
from collections.abc import Mapping, Sequence
from typing import NamedTuple

import numpy as np

from swarmtwin.diagnosis.diagnose import diagnose
from swarmtwin.diagnosis.reference import Reference
from swarmtwin.diagnosis.result import DetectionLimit, DiagnosedSession
from swarmtwin.dynamics.evaluation import predict
from swarmtwin.recordings.blocks import run_of
from swarmtwin.recordings.recording import Recording
from swarmtwin.robot import Robot
from swarmtwin.simulation.conditions import SessionConditions
from swarmtwin.simulation.mechanism import offered
from swarmtwin.studies.hidden_effects.baselines.black_box import learned_residual
from swarmtwin.studies.hidden_effects.baselines.correlation_rules import suggested_cause
from swarmtwin.studies.hidden_effects.baselines.parameter_fitting import fitted_causes
from swarmtwin.studies.hidden_effects.baselines.true_model import true_model_answer
from swarmtwin.studies.hidden_effects.cases import Case
from swarmtwin.studies.hidden_effects.held_out_gain import ONLY_RANDOM, Displacements, held_out_gain
from swarmtwin.studies.hidden_effects.peak_memory import forget_peak, peak_mb
from swarmtwin.studies.hidden_effects.results import Baselines, Result, is_another_unit
from swarmtwin.studies.hidden_effects.sessions import Truth, record_session
from swarmtwin.studies.stand_in_families import Family
from swarmtwin.transitions import from_recording


class Diagnosis(NamedTuple):
    """What came of one diagnosis: what was said of the session, by what reference, and at what cost."""

    reference: Reference
    diagnosed: DiagnosedSession
    learning_seconds: float
    seconds: float
    memory_mb: float


def diagnosis_of(reference: Recording, measured: Recording, seed: int) -> Diagnosis:
    """Learn the simulation from one recording and diagnose the other: all that the diagnosis ever sees of a case."""
    forget_peak()
    start = time.perf_counter()
    learned = Reference.learn(from_recording(reference)[0], seed)
    ready = time.perf_counter()
    diagnosed = diagnose(learned, measured, seed)
    return Diagnosis(learned, diagnosed, ready - start, time.perf_counter() - ready, peak_mb())


def score_case(case: Case, with_baselines: bool, with_true_model: bool, judged: Result | None = None) -> Result:
    """Record a case, diagnose it and compare what is said with what is true, and with what the true model would say.

    What was judged before is kept, and what it lacks of the other methods added. Those beside the diagnosis start from
    its reference, which is learned anew for them; the true model needs none.
    """
    reference, measured, truth = record_session(case)
    result = judged or Result(
        case=case,
        effects=truth.effects,
        true_causes=truth.causes,
        rise_percent=truth.rise_percent,
        same_vehicle=truth.same_vehicle,
        transitions=len(truth.measured.transitions),
    )
    if with_true_model and result.true_model is None:
        result = result.model_copy(update={"true_model": true_model_answer(truth)})
    if judged and (judged.failure or judged.baselines or not with_baselines):
        return result
    try:
        diagnosis = diagnosis_of(reference, measured, case.seed)
    except Exception as error:  # a study goes on, and counts it as a failure
        if judged:
            return result
        return result.model_copy(update={"failure": f"{type(error).__name__}: {error}"})
    diagnosed = diagnosis.diagnosed
    transitions, held_out, said = diagnosed.transitions, diagnosed.held_out, diagnosed.result
    simulated = predict(diagnosed.simulation, transitions)
    known = Displacements(transitions.displacement, simulated, truth.measured.least_displacement(transitions))
    twin = _twin(truth, diagnosed)
    extended = predict(diagnosed.extended or diagnosed.simulation, transitions)
    conditions = diagnosis.reference.conditions_for(transitions)
    baselines = None
    if with_baselines:
        residual = learned_residual(transitions, simulated, held_out, case.seed)
        baselines = Baselines(
            fitted=fitted_causes(diagnosis.reference, transitions),
            rule=suggested_cause(diagnosis.reference, transitions, simulated),
            black_box=held_out_gain(known, twin, residual, held_out),
        )
    if judged:
        return result.model_copy(update={"baselines": baselines})
    return result.model_copy(
        update={
            "verdict": said.verdict,
            "causes": said.causes,
            "true_causes": truth.causes_beside([cause.name for cause in said.causes]),
            "likeliest": said.posterior[0].causes if said.posterior else (),
            "depends_on": said.depends_on,
            "gained": held_out_gain(known, twin, extended, held_out),
            "times_limit": times_limit(truth.causes, said.detection_limits, transitions.robot, conditions, case.family),
            "baselines": baselines,
            "seconds": diagnosis.seconds,
            "learning_seconds": diagnosis.learning_seconds,
            "memory_mb": diagnosis.memory_mb,
        }
    )


def _twin(truth: Truth, diagnosed: DiagnosedSession) -> Displacements | None:
    """Return the displacements of the session without its effects; None where they do not tell what these brought.

    Where only an engine knows exact means, those of the held-out runs alone, so that what these runs have of their own
    is in both.
    """
    if not truth.effects:
        return None
    clean = truth.twin.transitions
    clean = clean.where(np.isfinite(clean.previous_command).all(axis=1))
    least = truth.twin.least_displacement(clean)
    if least is None:
        if ONLY_RANDOM.intersection(truth.case.names + truth.case.true_names):
            return None
        transitions = diagnosed.transitions
        held_out = {run_of(transitions.runs[run]) for run in np.unique(transitions.run[diagnosed.held_out])}
        clean = clean.where(np.array([clean.runs[run] in held_out for run in clean.run]))
    return Displacements(clean.displacement, predict(diagnosed.simulation, clean), least)


def times_limit(
    causes: Mapping[str, Mapping[str, float]],
    limits: Sequence[DetectionLimit],
    robot: Robot,
    conditions: SessionConditions,
    family: Family,
) -> float | None:
    """Return the size of the cause that is smallest beside its detection limit, over that: `Result.times_limit`."""
    times = [_times_limit(name, true, limits, robot, conditions, family) for name, true in causes.items()]
    known = [one for one in times if one is not None]
    return min(known) if known and len(known) == len(times) else None


def _times_limit(
    name: str,
    true: Mapping[str, float],
    limits: Sequence[DetectionLimit],
    robot: Robot,
    conditions: SessionConditions,
    family: Family,
) -> float | None:
    limit = next((one for one in limits if one.cause == name), None)
    if limit and "speed_mm_s" in true:
        return abs(true["speed_mm_s"] / limit.value) if limit.value else 0.0
    if limit is None or limit.parameter not in true or is_another_unit(family, robot.name, name, limit.parameter):
        return None
    if limit.value is None:
        return 0.0
    parameter = offered(robot, conditions)[name].parameters_of(robot, conditions)[limit.parameter]
    null = parameter.null_value or 0.0
    size = math.hypot(*true.values()) if name == "marker_offset" else true[limit.parameter] - null
    return abs(size / (limit.value - null))
