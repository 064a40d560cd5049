"""Diagnoses one case, and compares what is said with what only the stand-in knows."""

import time
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from swarmtwin.diagnosis.diagnose import diagnose
from swarmtwin.diagnosis.reference import Reference
from swarmtwin.diagnosis.result import DiagnosedSession
from swarmtwin.dynamics.evaluation import predict
from swarmtwin.geometry import orientation_error_rad, position_error_mm
from swarmtwin.recordings.recording import Recording
from swarmtwin.studies.hidden_effects.baselines.black_box import learned_residual
from swarmtwin.studies.hidden_effects.baselines.correlation_rules import suggested_cause
from swarmtwin.studies.hidden_effects.baselines.parameter_fitting import fitted_causes
from swarmtwin.studies.hidden_effects.baselines.true_model import true_model_answer
from swarmtwin.studies.hidden_effects.cases import Case
from swarmtwin.studies.hidden_effects.peak_memory import forget_peak, peak_mb
from swarmtwin.studies.hidden_effects.results import Baselines, HeldOutGain, Result
from swarmtwin.studies.hidden_effects.sessions import record_session
from swarmtwin.transitions import from_recording


@dataclass(frozen=True)
class Displacements:
    """N displacements of a stand-in's session in three versions, each (N, 3).

    Attributes:
        measured: as the camera saw them.
        simulated: as the simulation predicts them.
        exact_mean: as the stand-in would do them on average, given its true state; None where only an engine knows.
    """

    measured: np.ndarray
    simulated: np.ndarray
    exact_mean: np.ndarray | None

    def excess(self, predicted: np.ndarray, chosen: np.ndarray | slice = slice(None)) -> float:
        """Return by how much the squared errors of (N, 3) exceed those of the exact mean, as a share of these.

        Position and turn count alike. Squared, since that is what an exact mean makes least.
        """
        assert self.exact_mean is not None
        measured, exact_mean, ratios = self.measured[chosen], self.exact_mean[chosen], []
        for error in (position_error_mm, orientation_error_rad):
            least = (error(exact_mean, measured) ** 2).mean()
            ratios.append((error(predicted[chosen], measured) ** 2).mean() / least)
        return float(np.mean(ratios) - 1.0)


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


def score_case(case: Case, with_baselines: bool, with_true_model: bool) -> Result:
    """Record a case, diagnose it and compare what is said with what is true, and with what the true model would say."""
    reference, measured, truth = record_session(case)
    result = Result(
        case=case,
        effects=truth.effects,
        true_causes=truth.causes,
        rise_percent=truth.rise_percent,
        same_vehicle=truth.same_vehicle,
        transitions=len(truth.measured.transitions),
        true_model=true_model_answer(truth) if with_true_model else None,
    )
    try:
        diagnosis = diagnosis_of(reference, measured, case.seed)
    except Exception as error:  # a study goes on, and counts it as a failure
        return result.model_copy(update={"failure": f"{type(error).__name__}: {error}"})
    diagnosed = diagnosis.diagnosed
    transitions, held_out, said = diagnosed.transitions, diagnosed.held_out, diagnosed.result
    simulated = predict(diagnosed.simulation, transitions)
    known = Displacements(transitions.displacement, simulated, truth.measured.least_displacement(transitions))
    twin = None
    if truth.effects:
        clean = truth.twin.transitions
        clean = clean.where(np.isfinite(clean.previous_command).all(axis=1))
        expected = predict(diagnosed.simulation, clean)
        twin = Displacements(clean.displacement, expected, truth.twin.least_displacement(clean))
    baselines = None
    if with_baselines:
        residual = learned_residual(transitions, simulated, held_out, case.seed)
        baselines = Baselines(
            fitted=fitted_causes(diagnosis.reference, transitions),
            rule=suggested_cause(diagnosis.reference, transitions, simulated),
            black_box=_gain(known, twin, residual, held_out),
        )
    return result.model_copy(
        update={
            "verdict": said.verdict,
            "causes": said.causes,
            "depends_on": said.depends_on,
            "gained": _gain(known, twin, predict(diagnosed.extended or diagnosed.simulation, transitions), held_out),
            "baselines": baselines,
            "seconds": diagnosis.seconds,
            "learning_seconds": diagnosis.learning_seconds,
            "memory_mb": diagnosis.memory_mb,
        }
    )


def _gain(
    known: Displacements, twin: Displacements | None, extended: np.ndarray, held_out: np.ndarray, least: float = 0.04
) -> HeldOutGain:
    """Compare displacements (N, 3) of an extended simulation with those of the simulation, on held-out runs.

    Where the effect brought less squared error than a share `least` of the exact mean's, no share of it is stated: it
    would be one of noise. Nor is one where nothing is hidden, and there is no clean twin, or nobody knows exact means.
    """

    def error_mm(predicted: np.ndarray) -> float:
        return float(position_error_mm(predicted[held_out], known.measured[held_out]).mean())

    before_mm, after_mm, least_mm = error_mm(known.simulated), error_mm(extended), None
    share, share_to_floor = None, None
    if known.exact_mean is not None:
        least_mm = error_mm(known.exact_mean)
    if twin and least_mm is not None:
        before, after = known.excess(known.simulated, held_out), known.excess(extended, held_out)
        brought = before - twin.excess(twin.simulated)
        share = (before - after) / brought if brought > least else None
        share_to_floor = (before - after) / before if before > least else None
    return HeldOutGain(
        before_mm=before_mm, after_mm=after_mm, least_mm=least_mm, share=share, share_to_floor=share_to_floor
    )
