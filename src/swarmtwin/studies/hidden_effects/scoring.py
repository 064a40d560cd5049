"""Diagnoses one case, and compares what is said with what only the stand-in knows."""

import time
from dataclasses import dataclass

import numpy as np

from swarmtwin.diagnosis.diagnose import diagnose
from swarmtwin.diagnosis.reference import Reference
from swarmtwin.dynamics.evaluation import ErrorFigure, predict
from swarmtwin.geometry import orientation_error_rad, position_error_mm
from swarmtwin.robot import Robot
from swarmtwin.studies.hidden_effects.baselines.black_box import learned_residual
from swarmtwin.studies.hidden_effects.baselines.correlation_rules import suggested_cause
from swarmtwin.studies.hidden_effects.baselines.parameter_fitting import fitted_causes
from swarmtwin.studies.hidden_effects.cases import Case
from swarmtwin.studies.hidden_effects.results import Baselines, HeldOutGain, Result
from swarmtwin.studies.hidden_effects.sessions import clean_twin, measure


@dataclass(frozen=True)
class Displacements:
    """N displacements of a stand-in's session in three versions, each (N, 3).

    Attributes:
        measured: as the camera saw them.
        simulated: as the simulation predicts them.
        exact_mean: as the stand-in would do them on average, given its true state.
    """

    measured: np.ndarray
    simulated: np.ndarray
    exact_mean: np.ndarray

    def excess(self, predicted: np.ndarray, chosen: np.ndarray | slice = slice(None)) -> float:
        """Return by how much the squared errors of (N, 3) exceed those of the exact mean, as a share of these.

        Position and turn count alike. Squared, since that is what an exact mean makes least.
        """
        measured, ratios = self.measured[chosen], []
        for error in (position_error_mm, orientation_error_rad):
            least = (error(self.exact_mean[chosen], measured) ** 2).mean()
            ratios.append((error(predicted[chosen], measured) ** 2).mean() / least)
        return float(np.mean(ratios) - 1.0)


def score_case(case: Case, robot: Robot, reference: Reference, with_baselines: bool) -> Result:
    """Diagnose a case and compare what is said with what is true. The diagnosis sees the recording alone."""
    session = measure(case, robot)
    start = time.perf_counter()
    try:
        diagnosed = diagnose(reference, session.recording, case.seed)
    except Exception as error:  # a study goes on, and counts it as a failure
        failure = f"{type(error).__name__}: {error}"
        seconds = time.perf_counter() - start
        return Result(case=case, rise_percent=100.0 if case.effects else 0.0, failure=failure, seconds=seconds)
    seconds = time.perf_counter() - start
    transitions, held_out, said = diagnosed.transitions, diagnosed.held_out, diagnosed.result
    simulated = predict(diagnosed.simulation, transitions)
    known = Displacements(transitions.displacement, simulated, session.least_displacement(transitions))
    twin, rise = None, 0.0
    if case.effects:
        clean = clean_twin(case, robot)
        usual = clean.transitions.where(np.isfinite(clean.transitions.previous_command).all(axis=1))
        expected = predict(diagnosed.simulation, usual)
        twin = Displacements(usual.displacement, expected, clean.least_displacement(usual))
        rise = rise_percent(*(ErrorFigure.between(one.simulated, one.measured) for one in (known, twin)))
    baselines = None
    if with_baselines:
        residual = learned_residual(transitions, simulated, held_out, case.seed)
        baselines = Baselines(
            fitted=fitted_causes(reference, transitions),
            rule=suggested_cause(reference, transitions, simulated),
            black_box=_gain(known, twin, residual, held_out),
        )
    return Result(
        case=case,
        rise_percent=rise,
        verdict=said.verdict,
        causes=said.causes,
        depends_on=said.depends_on,
        gained=_gain(known, twin, predict(diagnosed.extended or diagnosed.simulation, transitions), held_out),
        baselines=baselines,
        seconds=seconds,
    )


def rise_percent(now: ErrorFigure, usual: ErrorFigure) -> float:
    """Return by how much one-step errors are larger than those of the clean twin: the larger of both rises."""
    rise = max(now.position_mm / usual.position_mm, now.orientation_deg / usual.orientation_deg)
    return 100.0 * (rise - 1.0)


def _gain(
    known: Displacements, twin: Displacements | None, extended: np.ndarray, held_out: np.ndarray, least: float = 0.04
) -> HeldOutGain:
    """Compare displacements (N, 3) of an extended simulation with those of the simulation, on held-out runs.

    Where the effect brought less squared error than a share `least` of the exact mean's, no share of it is stated: it
    would be one of noise. Nor is one where nothing is hidden, and there is no clean twin.
    """
    before_mm, after_mm, least_mm = (
        float(position_error_mm(predicted[held_out], known.measured[held_out]).mean())
        for predicted in (known.simulated, extended, known.exact_mean)
    )
    share, share_to_floor = None, None
    if twin:
        before, after = known.excess(known.simulated, held_out), known.excess(extended, held_out)
        brought = before - twin.excess(twin.simulated)
        share = (before - after) / brought if brought > least else None
        share_to_floor = (before - after) / before if before > least else None
    return HeldOutGain(
        before_mm=before_mm, after_mm=after_mm, least_mm=least_mm, share=share, share_to_floor=share_to_floor
    )
