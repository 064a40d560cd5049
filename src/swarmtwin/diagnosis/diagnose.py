"""From measured data to a cause with a name, an extended simulation and its gain, in four steps.

1. Reference and residual: what a simulation gets wrong, in units of the noise it has where nothing is wrong
   (`reference`, `noise`, `discrepancy`, `unit_spread`; `session_prediction` runs the simulation along a session).
2. Dependence: what the residual depends on (`dependence`, `flexible_residual`).
3. Causes: which sets of mechanisms make the session likely, with what nobody knows exactly integrated out
   (`likelihood`, `random_effects`, `lost_commands`, `screening`, `estimation`, `cause_search`), and what the best of
   them leaves (`explanation`, `left_over`, `error_history`, `motion_noise_change`).
4. Finding: causes as they are reported and the leading sets, gains on held-out runs, the smallest effects that the
   session would have shown, the next recording (`cause_report`, `gains`, `detection_limits` with `sized_causes` and
   `random_limits`, `next_recording`, `result`; pictures in `report/`).
"""

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import NamedTuple

import numpy as np
import torch

from swarmtwin.diagnosis.cause_report import leading_sets, reported_causes
from swarmtwin.diagnosis.cause_search import CausePosterior, CauseSearch
from swarmtwin.diagnosis.dependence import StandardisedResidual, dependence_tests
from swarmtwin.diagnosis.detection_limits import detection_limits
from swarmtwin.diagnosis.error_history import nats_by_history
from swarmtwin.diagnosis.estimation import Progress, estimate
from swarmtwin.diagnosis.explanation import Explanation, explanation, left_by_nothing
from swarmtwin.diagnosis.gains import Errors, Gains, gains, likelihood_gain, not_confirmed, scored_tracks
from swarmtwin.diagnosis.left_over import Usual
from swarmtwin.diagnosis.likelihood import (
    FittedMechanisms,
    MechanismClass,
    SessionLikelihood,
    arriving,
    loses_commands,
)
from swarmtwin.diagnosis.measured_session import MeasuredSession
from swarmtwin.diagnosis.next_recording import next_recording
from swarmtwin.diagnosis.own_units import unit_differences
from swarmtwin.diagnosis.reference import Reference
from swarmtwin.diagnosis.result import Cause, Dependence, DiagnosedSession, DiagnosisResult, Extension
from swarmtwin.recordings.recording import Recording, Track
from swarmtwin.simulation.mechanism import Mechanism, offered
from swarmtwin.simulation.mechanisms import noise_change
from swarmtwin.simulation.residual_model import ResidualModel
from swarmtwin.simulation.simulation import Simulation
from swarmtwin.transitions import Transitions


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
    model = reference.likelihood_of(session.where(~held_out))

    # 2. Dependence
    _tell(progress, "tests")
    tests = DependenceTests(reference, model, seed)
    dependences = tests.run(model, model.evaluate([]))

    # 3. Causes
    found = find_causes(reference, model, progress)
    usual = usual_of(reference)
    explained = explanation(model, found, usual)

    # 4. Finding
    _tell(progress, "what is left")
    simulation = Simulation(reference.base, (), session.conditions)
    transitions = session.transitions
    scored = transitions.where(held_out)
    runs = HeldOutRuns(reference, simulation, session, scored, scored_tracks(measured, believable, scored), seed)
    judged = runs.judge(explained)
    if judged.objection and explained.may_be_chance:
        nothing = left_by_nothing(model, found, usual)
        if nothing.verdict == "no_gap":  # what these causes gain was the fitted runs' own
            explained, judged = nothing, runs.judge(nothing)
    after = tests.run(explained.model, explained.best.fitted) if explained.best.names else dependences
    extended, objection, unfitted = judged.extended, judged.objection, runs.unfitted
    named = reported_causes(explained, rng)
    limits = detection_limits(explained, unfitted)
    plan, drive = next_recording(explained, limits, seed)
    result = DiagnosisResult(
        verdict="unexplained" if objection else explained.verdict,
        causes=() if objection else named,
        depends_on=tuple(test.part for test in dependences if test.found) if explained.verdict != "no_gap" else (),
        gain=judged.gain,
        next_recording=None if objection else plan,
        left_over=tuple(test.part for test in after if test.found) if explained.is_something_left else (),
        tests=tuple(dependences),
        robot=reference.robot.name,
        vehicles=tuple(transitions.vehicles[index] for index in np.unique(transitions.vehicle)),
        runs={"fitted": model.session.runs, "held_out": len(np.unique(scored.run))},
        transitions={"used": len(session), "set_aside": set_aside},
        extension=_extension(extended),
        not_confirmed=_with_names(objection, named) if objection else None,
        units=unit_differences(explained.model, () if objection else explained.mechanisms),
        detection_limits=tuple(one.limit for one in limits),
        posterior=leading_sets(explained.posterior, reference.settings.search.reported_sets),
        seed=seed,
    )
    parts = ((~held_out, explained.model), (held_out, unfitted.explained_by(explained.best.mechanisms)))
    residual = _together((rows, part.evaluate([]).residual) for rows, part in parts)
    explained_residual = residual
    if extended:
        explained_residual = _together((rows, _residual_of(extended, part)) for rows, part in parts)
    return DiagnosedSession(
        result=result,
        simulation=simulation,
        extended=extended,
        transitions=transitions,
        held_out=held_out,
        residual_before=residual,
        residual_after=explained_residual,
        runs_before=runs.errors.open_loop,
        runs_after=judged.errors.open_loop,
        next_drive=drive,
    )


class HeldOutJudgement(NamedTuple):
    """What runs that nothing was fitted to say of an explanation.

    Attributes:
        extended: the simulation with what was found; None where nothing is wrong.
        errors: of that, or of the simulation as it was.
        gain: of the extension.
        objection: why they do not confirm it; None where they do.
    """

    extended: Simulation | None
    errors: Errors
    gain: Gains
    objection: str | None


@dataclass(frozen=True)
class HeldOutRuns:
    """Runs that nothing was fitted to.

    Attributes:
        reference: the reference.
        simulation: as it was.
        session: all of the session.
        scored: the transitions of these runs.
        tracks: what was driven in them, for open loop.
        seed: of everything random.
    """

    reference: Reference
    simulation: Simulation
    session: MeasuredSession
    scored: Transitions
    tracks: list[Track]
    seed: int

    @cached_property
    def errors(self) -> Errors:
        """What the simulation errs in them as it was."""
        return Errors.of(self.simulation, self.scored, self.tracks)

    @cached_property
    def unfitted(self) -> SessionLikelihood:
        """The likelihood of these runs."""
        every = self.reference.settings.verdict.held_out_every
        return self.reference.likelihood_of(self.session.where(self.session.run % every == every - 1))

    def judge(self, explained: Explanation) -> HeldOutJudgement:
        """Extend the simulation by what was found, and measure what that gains."""
        settings = self.reference.settings.verdict
        extended = _extended(self.reference, self.simulation, explained, self.seed)
        errors = _errors_of(extended, self.session, self.scored, self.tracks) if extended else self.errors
        gain = gains(self.errors, errors, self.scored.run, settings.gain_draws, np.random.default_rng(self.seed))
        if not extended:
            return HeldOutJudgement(None, errors, gain, None)
        usual, rng = explained.motion_noise.usual, np.random.default_rng(self.seed)
        likelihood = likelihood_gain(self.unfitted, extended, settings.gain_draws, rng, usual)
        moves = extended.residual is not None or bool(arriving(explained.mechanisms))
        return HeldOutJudgement(extended, errors, gain, not_confirmed(gain, likelihood, settings.immaterial, moves))


class DependenceTests:
    """Tests of a session's residuals, with any causes taken into account, against the reference's own.

    Args:
        reference: the reference.
        model: of the session.
        seed: of the draws, the same for every test.
    """

    def __init__(self, reference: Reference, model: SessionLikelihood, seed: int) -> None:
        self._seed, self._discrepancy = seed, reference.discrepancy is not None
        neighbours = reference.settings.reference.overlap_neighbours
        own = reference.own_likelihood()
        weight = model.session.covariate_overlap(own.session, neighbours)
        self._of_reference = StandardisedResidual.of(own, own.evaluate([]), weight)

    def run(self, model: SessionLikelihood, fitted: FittedMechanisms) -> list[Dependence]:
        """Test what fitted mechanisms leave of a session."""
        left = StandardisedResidual.of(model, fitted)
        return dependence_tests(left, self._of_reference, self._seed, model.settings.dependence, self._discrepancy)


def find_causes(reference: Reference, model: SessionLikelihood, progress: Progress | None) -> CausePosterior:
    """Search for the causes; in a long session in a part of its runs, their values are then estimated in all of it."""
    found = offered(model.robot, model.session.conditions)
    kinds = {name: kind for name, kind in found.items() if kind.noise_factor is Mechanism.noise_factor}
    session = model.session
    every = -(-len(session) // reference.settings.search.most_transitions)
    part = model if every <= 1 else reference.likelihood_of(session.where(session.run % every == 0))
    return CauseSearch(part, kinds, progress, lambda: usual_loss(reference, kinds)).run()


def usual_loss(reference: Reference, kinds: Mapping[str, MechanismClass]) -> float:
    """Return the share of commands that the reference itself seems to lose: times that are not exact look like that.

    It is none where what the reference gets wrong is a gap as well (no `discrepancy`).
    """
    lossy = [kind for kind in kinds.values() if loses_commands([kind])]
    if reference.discrepancy is None or not lossy:
        return 0.0
    own = reference.own_likelihood(reference.settings.search.most_transitions)
    points = lossy[0].initial_points(own.robot, own.session.conditions)
    return float(estimate(own, [lossy[0].at(points[0])]).values[0])


def usual_of(reference: Reference) -> Usual:
    """Return what the reference's own motion and errors show, measured as those of a session are."""

    def own() -> SessionLikelihood:
        return reference.own_likelihood(reference.settings.search.most_transitions)

    def history_nats() -> float:
        model = own()
        return max(nats_by_history(model, model.evaluate([])), 0.0) / len(model.session)

    return Usual(lambda: own().motion_noise_log()[0], history_nats, lambda: len(own().session))


def _errors_of(extended: Simulation, session: MeasuredSession, scored: Transitions, tracks: list[Track]) -> Errors:
    """Return an extended simulation's errors; delays act to the moment where it is known when commands were sent."""
    late = [mechanism for mechanism in extended.mechanisms if mechanism.latency_s() > 0]
    if not session.sent or not late or extended.residual:
        return Errors.of(extended, scored, tracks)
    late_s = sum(mechanism.latency_s() for mechanism in late)
    others = [mechanism for mechanism in extended.mechanisms if mechanism not in late]
    log = session.sent._replace(transitions=scored)
    command, previous, earlier = log.late(late_s)
    return Errors.of(
        Simulation(extended.dynamics, others, extended.conditions),
        replace(scored, command=command, previous_command=previous, earlier_command=earlier),
        [log.acting_late(track, late_s) for track in tracks],
    )


def _extended(reference: Reference, simulation: Simulation, explained: Explanation, seed: int) -> Simulation | None:
    """Return the simulation with what was found, mechanisms or a learned residual; None where nothing is wrong."""
    if explained.verdict == "no_gap":
        return None
    mechanisms = _with_own_unit(reference, explained) if explained.mechanisms else ()
    if explained.names_motion_noise:
        mechanisms = (*mechanisms, noise_change.Config(factor=explained.motion_noise.factor))
    residual = None
    if explained.verdict == "unexplained":
        model, session = explained.model, explained.model.session
        mechanisms = explained.best.mechanisms if explained.share >= 0.5 else ()
        given = session.situation
        assert given.previous_command is not None
        residual, _ = ResidualModel.learn(
            model.predictor.moment(),
            given.command,
            given.previous_command,
            session.run,
            session.residual_of(model.predictor.most_likely_twist(mechanisms)),
            torch.as_tensor(model.noise.spread(model.motion)),
            seed,
        )
    return Simulation(simulation.dynamics, mechanisms, simulation.conditions, residual)


def _with_own_unit(reference: Reference, explained: Explanation) -> tuple[Mechanism, ...]:
    """Return the causes, and beside them what is a vehicle's own by fabrication, where the reference does not know it.

    That is no cause, but without it the extended simulation would be one of another vehicle.
    """
    model, named = explained.model, explained.mechanisms
    if len(model.strange) != 1 or len(model.session.transitions.vehicles) != 1:
        return named
    known = {one.name for one in named}
    kinds = {name: kind for name, kind in offered(model.robot, model.session.conditions).items() if name not in known}
    own = [
        kinds[name].at(_doing_nothing(kinds[name], model))
        for name in ("gain_change", "actuator_asymmetry")
        if name in kinds
    ]
    alone = SessionLikelihood(
        reference.base, reference.noise, model.session, (), 0.0, reference.discrepancy, reference.settings
    )
    return estimate(alone, [*named, *own]).mechanisms


def _doing_nothing(kind: type[Mechanism], model: SessionLikelihood) -> dict[str, float]:
    parameters = kind.parameters_of(model.robot, model.session.conditions)
    return {name: one.null_value for name, one in parameters.items() if one.null_value is not None}


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


def _residual_of(extended: Simulation, model: SessionLikelihood) -> np.ndarray:
    """Return (N, 3) the standardised residuals of an extended simulation."""
    if extended.residual is None:
        return model.evaluate(extended.mechanisms, model.effects).residual
    twist = model.predictor.most_likely_twist(extended.mechanisms, extended.residual)
    whitened: np.ndarray = model.filter(model.errors_of(twist)[..., None])[..., 0]
    return whitened
