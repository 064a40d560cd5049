"""The whole way from measured data to a named cause, an extended simulation and its gain (DESIGN section 7)."""

from typing import Literal

import numpy as np

from swarmtwin.dynamics.open_loop import OpenLoop, open_loop
from swarmtwin.dynamics.twist import twist_of
from swarmtwin.errors import UserError
from swarmtwin.gap.diagnosis import Diagnosis, Gains, NextRecording
from swarmtwin.gap.examination import Examination, Found
from swarmtwin.gap.extended import ExtendedDynamics
from swarmtwin.gap.finding import Finding
from swarmtwin.gap.fitting import Problem
from swarmtwin.gap.gains import gains, one_step_errors
from swarmtwin.gap.motion import likeliest_displacement
from swarmtwin.gap.naming import Report
from swarmtwin.gap.noise import residual_of
from swarmtwin.gap.reference import Reference, require_enough
from swarmtwin.gap.separation import separating_drive
from swarmtwin.gap.session import Session
from swarmtwin.gap.telling import told_causes
from swarmtwin.recordings.recording import Recording
from swarmtwin.transitions import from_recording

HELD_OUT_EVERY = 4

Extension = Literal["mechanisms", "learned_residual", "mechanisms_and_learned_residual", "none"]


def diagnose(reference: Reference, measured: Recording, seed: int, report: Report | None = None) -> Finding:
    """Compare a measured recording with a simulation: what is wrong, why, and what an extension gains.

    A quarter of the runs, every fourth, is held out: nothing is fitted to it, and the gain is measured on it.

    Args:
        reference: the simulation and its noise.
        measured: the recording in question; nothing but its runs is looked at.
        seed: of everything random.
        report: called with what is being done, and how far it is.

    Raises:
        UserError: too few runs, another robot, constant commands, or commands that the reference does not cover.
    """
    session, set_aside = _session(reference, measured)
    held_out = session.run % HELD_OUT_EVERY == HELD_OUT_EVERY - 1
    examination = Examination(reference, session.where(~held_out), seed, report)
    found = examination.run()
    verdict = found.verdict
    residual = found.residual if verdict == "unexplained" else None
    surroundings = session.drive.surroundings
    simulation = ExtendedDynamics(reference.base, (), surroundings)
    is_extended = bool(found.mechanisms or residual)
    extended = ExtendedDynamics(reference.base, found.mechanisms, surroundings, residual) if is_extended else None
    measured_gains, loops = _gains(measured, session, held_out, simulation, extended, seed)
    plan, drive = _next_recording(examination, found)
    transitions = session.transitions
    diagnosis = Diagnosis(
        verdict=verdict,
        causes=told_causes(examination, found),
        depends_on=tuple(test.part for test in found.before if test.found),
        gain=measured_gains,
        next_recording=plan,
        left_over=found.left_over,
        tests=tuple(found.before),
        robot=reference.robot.name,
        vehicles=tuple(transitions.vehicles[index] for index in np.unique(transitions.vehicle)),
        runs={"fitted": examination.problem.session.runs, "held_out": len(np.unique(session.run[held_out]))},
        transitions={"used": len(session), "set_aside": set_aside},
        extension=_extension(extended),
        seed=seed,
    )
    problem = Problem(reference.base, reference.noise, session)
    before = problem.evaluate([]).residual
    after = _standardised(problem, extended) if extended else before
    return Finding(diagnosis, simulation, extended, transitions, held_out, before, after, *loops, drive)


def _session(reference: Reference, measured: Recording) -> tuple[Session, int]:
    """Return the measured transitions that can be compared, and how many the reference does not cover."""
    robot = reference.robot
    if measured.robot.name != robot.name or measured.robot.command_columns != robot.command_columns:
        raise UserError(f"the measured recording is of robot {measured.robot.name!r}, the simulation of {robot.name!r}")
    transitions, _ = from_recording(measured)
    covered = reference.covered(transitions.command)
    surroundings = reference.surroundings_for(transitions, measured.header.arena_mm)
    require_enough(Session.of(transitions, surroundings), "measured")
    session = Session.of(transitions.where(covered), surroundings)
    require_enough(session, "measured", ", as far as the reference covers its commands,")
    return session, int((~covered).sum())


def _gains(
    measured: Recording,
    session: Session,
    held_out: np.ndarray,
    simulation: ExtendedDynamics,
    extended: ExtendedDynamics | None,
    seed: int,
) -> tuple[Gains, tuple[tuple[OpenLoop, ...], tuple[OpenLoop, ...]]]:
    """Measure errors on the held-out runs with and without the extension."""
    unseen = session.transitions.where(held_out)
    names = {unseen.runs[index] for index in np.unique(unseen.run)}
    tracks = [track for track in measured.tracks if track.run in names]
    before, loops_before = one_step_errors(simulation, unseen), tuple(open_loop(simulation, tracks))
    after, loops_after = before, loops_before
    if extended:
        after, loops_after = one_step_errors(extended, unseen), tuple(open_loop(extended, tracks))
    rng = np.random.default_rng(seed)
    return gains(before, after, unseen.run, loops_before, loops_after, rng), (loops_before, loops_after)


def _extension(extended: ExtendedDynamics | None) -> Extension:
    if extended is None:
        return "none"
    if extended.residual is None:
        return "mechanisms"
    return "mechanisms_and_learned_residual" if extended.mechanisms else "learned_residual"


def _standardised(problem: Problem, extended: ExtendedDynamics) -> np.ndarray:
    """Return (N, 3) the standardised residuals of an extended simulation."""
    if extended.residual is None:
        return problem.evaluate(extended.mechanisms).residual
    drive = problem.session.drive
    way = twist_of(likeliest_displacement(problem.base, extended.mechanisms, drive)) + extended.residual.way(drive)
    whitened: np.ndarray = problem.whitener(residual_of(problem.session, way)).numpy()
    return whitened


def _next_recording(examination: Examination, found: Found) -> tuple[NextRecording | None, np.ndarray | None]:
    """Plan the drive that separates the first cause that has rivals from the nearest of them."""
    for index, rivals in enumerate(found.named.rivals if found.are_named else ()):
        if rivals:
            nearest = min(rivals, key=lambda name: float(rivals[name].sum()))
            others = tuple(one for number, one in enumerate(found.mechanisms) if number != index)
            rival = examination.fitted(others, nearest)
            return separating_drive(
                examination.base,
                examination.reference.noise,
                examination.problem.surroundings,
                found.mechanisms,
                rival,
                examination.seed,
            )
    return None, None
