"""Diagnoses one case, and compares what is said with what only the stand-in knows."""

import time
from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from swarmtwin.diagnosis.diagnose import diagnose
from swarmtwin.diagnosis.reference import Reference
from swarmtwin.diagnosis.result import DiagnosisResult
from swarmtwin.dynamics.evaluation import predict
from swarmtwin.geometry import orientation_error_rad, position_error_mm, wrap_angle
from swarmtwin.robot import Robot
from swarmtwin.studies.hidden_effects.baselines.black_box import learned_residual
from swarmtwin.studies.hidden_effects.baselines.correlation_rules import suggested_cause
from swarmtwin.studies.hidden_effects.baselines.parameter_fitting import fit_all
from swarmtwin.studies.hidden_effects.cases import Case
from swarmtwin.studies.hidden_effects.results import (
    Baselines,
    HeldOutGain,
    ParameterEstimate,
    Result,
    Suspect,
)
from swarmtwin.studies.hidden_effects.sessions import HiddenSession, MeanErrors, clean_twin, measure
from swarmtwin.transitions import Transitions


@dataclass(frozen=True)
class KnownTransitions:
    """N transitions of a stand-in's session, with what only the stand-in knows of them.

    Attributes:
        transitions: what was measured.
        exact_mean: (N, 3) exact mean displacements.
        simulated: (N, 3) displacements that the simulation predicts.
    """

    transitions: Transitions
    exact_mean: np.ndarray
    simulated: np.ndarray

    def excess(self, predicted: np.ndarray, chosen: np.ndarray | slice = slice(None)) -> float:
        """Return by how much the squared errors of (N, 3) exceed those of the exact mean, as a share of these.

        Position and turn count alike. Squared, since that is what an exact mean makes least.
        """
        measured = self.transitions.displacement[chosen]
        errors = [_mean_squares(displacement[chosen], measured) for displacement in (predicted, self.exact_mean)]
        return float((errors[0] / errors[1]).mean() - 1.0)


def _mean_squares(predicted: np.ndarray, measured: np.ndarray) -> np.ndarray:
    """Return (2,) mean squared errors of position and turn."""
    position = position_error_mm(predicted, measured)
    turn = orientation_error_rad(predicted, measured)
    return np.array([(position**2).mean(), (turn**2).mean()])


def score_case(case: Case, robot: Robot, reference: Reference, with_baselines: bool) -> Result:
    """Diagnose a case and compare what is said with what is true. The diagnosis sees the recording alone."""
    session = measure(case, robot)
    start = time.perf_counter()
    try:
        diagnosed = diagnose(reference, session.recording, case.seed)
    except Exception as error:  # a study goes on, and counts it as a failure
        return Result(
            case=case,
            rise_percent=100.0 if case.effects else 0.0,
            verdict=None,
            failure=f"{type(error).__name__}: {error}",
            causes=(),
            parameters=(),
            depends_on=(),
            gained=None,
            baselines=None,
            seconds=time.perf_counter() - start,
        )
    seconds = time.perf_counter() - start
    transitions, held_out, diagnosis = diagnosed.transitions, diagnosed.held_out, diagnosed.result
    known = _known(session, transitions, predict(diagnosed.simulation, transitions))
    twin = known
    if case.effects:
        clean = clean_twin(case, robot)
        usual = clean.transitions.where(np.isfinite(clean.transitions.previous_command).all(axis=1))
        twin = _known(clean, usual, predict(diagnosed.simulation, usual))
    baselines = None
    if with_baselines:
        residual = learned_residual(transitions, known.simulated, held_out, case.seed)
        baselines = Baselines(
            fitted=fit_all(reference, transitions).named,
            rule=suggested_cause(reference, transitions, known.simulated),
            black_box=_gain(known, twin, residual, held_out),
        )
    return Result(
        case=case,
        rise_percent=_rise_percent(known, twin) if case.effects else 0.0,
        verdict=diagnosis.verdict,
        failure=None,
        causes=tuple(
            Suspect(name=cause.name, rivals=cause.rivals, confidence=cause.confidence, share_of_gap=cause.share_of_gap)
            for cause in diagnosis.causes
        ),
        parameters=tuple(compared_parameters(case, diagnosis)),
        depends_on=diagnosis.depends_on,
        gained=_gain(known, twin, predict(diagnosed.extended or diagnosed.simulation, transitions), held_out),
        baselines=baselines,
        seconds=seconds,
    )


def _known(session: HiddenSession, transitions: Transitions, simulated: np.ndarray) -> KnownTransitions:
    return KnownTransitions(transitions, session.least_displacement(transitions), simulated)


def _rise_percent(known: KnownTransitions, twin: KnownTransitions) -> float:
    """Return by how much the effect raised the simulation's one-step error."""
    now, usual = (MeanErrors.of(one.simulated, one.transitions.displacement) for one in (known, twin))
    return now.rise_percent(usual)


def _gain(known: KnownTransitions, twin: KnownTransitions, extended: np.ndarray, held_out: np.ndarray) -> HeldOutGain:
    """Compare displacements (N, 3) of an extended simulation with those of the simulation, on held-out runs.

    Where the effect brought less squared error than 4 % of the exact mean's, no share of it is stated: it would be one
    of noise. A session that is its own twin hides nothing, and has no share.
    """
    least_excess = 0.04
    measured = known.transitions.displacement[held_out]
    before_mm, after_mm, least_mm = (
        MeanErrors.of(predicted[held_out], measured).position_mm
        for predicted in (known.simulated, extended, known.exact_mean)
    )
    share, share_to_floor = None, None
    if twin is not known:
        before, after = (known.excess(predicted, held_out) for predicted in (known.simulated, extended))
        brought = before - twin.excess(twin.simulated)
        share = (before - after) / brought if brought > least_excess else None
        share_to_floor = (before - after) / before if before > least_excess else None
    return HeldOutGain(
        before_mm=before_mm, after_mm=after_mm, least_mm=least_mm, share=share, share_to_floor=share_to_floor
    )


def compared_parameters(case: Case, diagnosis: DiagnosisResult) -> Iterator[ParameterEstimate]:
    """Return what is said of the parameters of the causes that are true, beside what they are."""
    effects = {effect["name"]: effect for effect in case.effects} if case.kind != "outside" else {}
    for cause in diagnosis.causes:
        for name, estimate in cause.parameters.items():
            true = effects.get(cause.name, {}).get(name)
            if true is None:
                continue
            if name == "direction_rad":  # the same direction, as near to what is said as it can be told
                true = estimate.value + float(wrap_angle(np.array(true - estimate.value)))
            yield ParameterEstimate(
                cause=cause.name,
                name=name,
                true=true,
                value=estimate.value,
                low=estimate.low,
                high=estimate.high,
                unit=estimate.unit,
            )
