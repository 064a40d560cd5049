"""Diagnoses one case, and compares what is said with what only the stand-in knows."""

import time
from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from swarmtwin.commands.experiments.hidden_effects_cases import Case
from swarmtwin.commands.experiments.hidden_effects_results import Baselines, Gained, Parameter, Result, Suspect
from swarmtwin.commands.experiments.hidden_effects_sessions import Errors, Measured, clean_twin, measure
from swarmtwin.dynamics.evaluation import predict
from swarmtwin.gap.baselines.black_box import learned_residual
from swarmtwin.gap.baselines.correlation_rules import suggested_cause
from swarmtwin.gap.baselines.parameter_fitting import fit_all
from swarmtwin.gap.diagnosing import diagnose
from swarmtwin.gap.diagnosis import Diagnosis
from swarmtwin.gap.finding import Finding
from swarmtwin.gap.reference import Reference
from swarmtwin.geometry import orientation_error_rad, position_error_mm, wrap_angle
from swarmtwin.robot import Robot
from swarmtwin.transitions import Transitions

LEAST_EXCESS = 0.04
"""Squared error over that of the exact mean, as a share of it, below which no share of a gain is told."""


@dataclass(frozen=True)
class Truth:
    """What only the stand-in knows of N transitions.

    Attributes:
        transitions: what was measured.
        least: (N, 3) exact mean displacements.
    """

    transitions: Transitions
    least: np.ndarray

    @classmethod
    def of(cls, measured: Measured, transitions: Transitions) -> "Truth":
        """Look up transitions of a session."""
        return cls(transitions, measured.least_displacement(transitions))

    def excess(self, predicted: np.ndarray, chosen: np.ndarray | slice = slice(None)) -> float:
        """Return by how much the squared errors of (N, 3) exceed those of the exact mean, as a share of these.

        Position and turn count alike. Squared, since that is what an exact mean makes least.
        """
        measured = self.transitions.displacement[chosen]
        squared, least = (_squared(displacement[chosen], measured) for displacement in (predicted, self.least))
        return float((squared / least).mean() - 1.0)


def _squared(predicted: np.ndarray, measured: np.ndarray) -> np.ndarray:
    """Return (2,) mean squared errors of position and turn."""
    position = position_error_mm(predicted, measured)
    turn = orientation_error_rad(predicted, measured)
    return np.array([(position**2).mean(), (turn**2).mean()])


def examine(case: Case, robot: Robot, reference: Reference, with_baselines: bool) -> Result:
    """Diagnose a case. The diagnosis sees its recording alone."""
    measured = measure(case, robot)
    start = time.perf_counter()
    try:
        finding = diagnose(reference, measured.recording, case.seed)
    except Exception as error:  # a study goes on, and counts it as a failure
        return _failed(case, f"{type(error).__name__}: {error}", time.perf_counter() - start)
    seconds = time.perf_counter() - start
    judge = _Judge(case, robot, reference, measured, finding)
    diagnosis = finding.diagnosis
    return Result(
        case=case,
        rise_percent=judge.rise_percent(),
        verdict=diagnosis.verdict,
        failure=None,
        causes=tuple(
            Suspect(name=cause.name, rivals=cause.rivals, confidence=cause.confidence, share_of_gap=cause.share_of_gap)
            for cause in diagnosis.causes
        ),
        parameters=tuple(compared_parameters(case, diagnosis)),
        depends_on=diagnosis.depends_on,
        gained=judge.gained(predict(finding.extended or finding.simulation, finding.transitions)),
        baselines=judge.baselines() if with_baselines else None,
        seconds=seconds,
    )


def _failed(case: Case, failure: str, seconds: float) -> Result:
    return Result(
        case=case,
        rise_percent=100.0 if case.effects else 0.0,
        verdict=None,
        failure=failure,
        causes=(),
        parameters=(),
        depends_on=(),
        gained=None,
        baselines=None,
        seconds=seconds,
    )


class _Judge:
    """Knows what the stand-in knows of one case."""

    def __init__(self, case: Case, robot: Robot, reference: Reference, measured: Measured, finding: Finding) -> None:
        self.case, self.robot, self.reference, self.finding = case, robot, reference, finding
        self.recording = measured.recording
        self.truth = Truth.of(measured, finding.transitions)
        self.simulated = predict(finding.simulation, finding.transitions)
        self.twin = clean_twin(case, robot) if case.effects else measured
        self.twin_transitions = self.twin.transitions.where(
            np.isfinite(self.twin.transitions.previous_command).all(axis=1)
        )
        self.twin_simulated = predict(finding.simulation, self.twin_transitions)

    def rise_percent(self) -> float:
        """Return by how much the effect raised the simulation's one-step error."""
        if not self.case.effects:
            return 0.0
        now = Errors.of(self.simulated, self.finding.transitions.displacement)
        return now.rise_percent(Errors.of(self.twin_simulated, self.twin_transitions.displacement))

    def gained(self, extended: np.ndarray) -> Gained:
        """Compare displacements (N, 3) of an extended simulation with those of the simulation, on held-out runs."""
        held_out, measured = self.finding.held_out, self.finding.transitions.displacement
        errors = [
            Errors.of(predicted[held_out], measured[held_out]).position_mm
            for predicted in (self.simulated, extended, self.truth.least)
        ]
        share, to_floor = None, None
        if self.case.effects:
            before, after = (self.truth.excess(predicted, held_out) for predicted in (self.simulated, extended))
            usual = Truth.of(self.twin, self.twin_transitions).excess(self.twin_simulated)
            share = (before - after) / (before - usual) if before - usual > LEAST_EXCESS else None
            to_floor = (before - after) / before if before > LEAST_EXCESS else None
        return Gained(before_mm=errors[0], after_mm=errors[1], least_mm=errors[2], share=share, share_to_floor=to_floor)

    def baselines(self) -> Baselines:
        """Let the other methods work on the same case."""
        transitions = self.finding.transitions
        arena = self.recording.header.arena_mm
        added = learned_residual(transitions, self.simulated, self.finding.held_out, self.case.seed)
        return Baselines(
            fitted=fit_all(self.reference, transitions, arena).named,
            rule=suggested_cause(self.reference, transitions, self.simulated, arena),
            black_box=self.gained(added),
        )


def compared_parameters(case: Case, diagnosis: Diagnosis) -> Iterator[Parameter]:
    """Return what is said of the parameters of the causes that are true, beside what they are."""
    effects = {effect["name"]: effect for effect in case.effects} if case.kind != "outside" else {}
    for cause in diagnosis.causes:
        for name, estimate in cause.parameters.items():
            true = effects.get(cause.name, {}).get(name)
            if true is None:
                continue
            if name == "direction_rad":  # the same direction, as near to what is said as it can be told
                true = estimate.value + float(wrap_angle(np.array(true - estimate.value)))
            yield Parameter(
                cause=cause.name,
                name=name,
                true=true,
                value=estimate.value,
                low=estimate.low,
                high=estimate.high,
                unit=estimate.unit,
            )
