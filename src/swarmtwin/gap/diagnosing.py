"""The whole way from measured data to a named cause, an extended simulation and its gain (DESIGN section 7)."""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import torch

from swarmtwin.dynamics.open_loop import OpenLoop, open_loop
from swarmtwin.errors import UserError
from swarmtwin.gap.base import AnyBase
from swarmtwin.gap.catalogue import offered
from swarmtwin.gap.certainty import Certainty
from swarmtwin.gap.dependence import Examined, dependences
from swarmtwin.gap.diagnosis import Cause, Dependence, Diagnosis, Estimate, NextRecording, Verdict
from swarmtwin.gap.extended import ExtendedDynamics
from swarmtwin.gap.finding import Finding
from swarmtwin.gap.fitting import Fit, Kind, Problem
from swarmtwin.gap.gains import gains, one_step_errors
from swarmtwin.gap.learned import LearnedResidual
from swarmtwin.gap.mechanism import Mechanism
from swarmtwin.gap.mechanisms import noise_change
from swarmtwin.gap.naming import Named, Report, Search, refitted
from swarmtwin.gap.noise import residual_of
from swarmtwin.gap.noise_test import Spread, compare_spread
from swarmtwin.gap.reference import Reference, require_enough
from swarmtwin.gap.separation import separating_drive
from swarmtwin.gap.session import Session
from swarmtwin.dynamics.twist import twist_of
from swarmtwin.recordings.recording import Recording
from swarmtwin.transitions import Transitions, from_recording

HELD_OUT_EVERY = 4
MOST_SEARCHED = 6000
LEAST_EXPLAINED_SHARE = 0.7
MOST_LEFT_OVER = 0.15
LEAST_LEFT_OVER = 0.01
BOOTSTRAPS = 1000


def diagnose(reference: Reference, measured: Recording, seed: int, report: Report | None = None) -> Finding:
    """Compare a measured recording with a simulation: what is wrong, why, and what an extension gains.

    A quarter of the runs, every fourth, is held out: nothing is fitted to it, and the gain is measured on it.

    Raises:
        UserError: too few runs, another robot, constant commands, or nothing that the reference covers.
    """
    robot = reference.robot
    if measured.robot.name != robot.name or measured.robot.command_columns != robot.command_columns:
        raise UserError(f"the measured recording is of robot {measured.robot.name!r}, the simulation of {robot.name!r}")
    transitions, _ = from_recording(measured)
    surroundings = reference.surroundings_for(transitions, measured.header.arena_mm)
    covered = reference.covered(transitions.command)
    session = Session.of(transitions.where(covered), surroundings)
    require_enough(session, "measured")
    held_out = session.run % HELD_OUT_EVERY == HELD_OUT_EVERY - 1
    examination = _Examination(reference, session.where(~held_out), seed, report)
    found = examination.run()
    return _finding(reference, measured, session, held_out, examination, found, int((~covered).sum()))


@dataclass(frozen=True)
class _Found:
    """What an examination of the fitted runs says."""

    named: Named
    spread: Spread | None
    before: list[Dependence]
    after: list[Dependence]
    residual: LearnedResidual | None
    explained: float
    achievable: float


class _Examination:
    """The fitted runs, looked at step by step."""

    def __init__(self, reference: Reference, session: Session, seed: int, report: Report | None) -> None:
        self.reference, self.seed, self.report = reference, seed, report
        self.rng = np.random.default_rng(seed)
        self.base: AnyBase = reference.base
        self.problem = Problem(self.base, reference.noise, session)
        self.known = Problem(reference.unseen, reference.noise, reference.session)
        self.kinds: dict[str, Kind] = {
            name: kind
            for name, kind in offered(reference.robot, session.drive.surroundings).items()
            if kind is not noise_change.Config
        }
        self.nothing = self.problem.evaluate([])
        self.known_examined = Examined.of(self.known, self.known.evaluate([]), None)

    def run(self) -> _Found:
        """Test, name, test again, and learn what is left."""
        before = self._dependences(self.nothing)
        named = self._named()
        after = self._dependences(named.fit) if named.fit.mechanisms else before
        residual, explained, achievable = None, self._explained(named.fit), self._explained(named.fit)
        if any(test.found for test in after if test.part not in ("spread", "tails")):
            residual, more = self._learned(named.fit)
            achievable += more
        left = {test.part for test in after if test.found}
        spread = None
        if not left - {"spread", "tails"}:
            compared = compare_spread(self.problem, named.fit, self.known, self.base, self.rng)
            spread = compared if compared.is_news else None
        return _Found(named, spread, before, after, residual, explained, achievable)

    def _dependences(self, fit: Fit) -> list[Dependence]:
        return dependences(Examined.of(self.problem, fit, self.base), self.known_examined, self.seed)

    def _named(self) -> Named:
        """Name the causes, on part of a long session first."""
        session = self.problem.session
        if len(session) <= MOST_SEARCHED:
            return Search(self.problem, self.known, self.base, self.kinds, self.report).run()
        every = -(-len(session) // MOST_SEARCHED)
        smaller = Problem(self.base, self.reference.noise, session.where(session.run % every == 0))
        named = Search(smaller, self.known, self.base, self.kinds, self.report).run()
        return refitted(named, self.problem, self.base)

    def _explained(self, fit: Fit) -> float:
        """Return the mean squared standardised residual that a fit takes away."""
        return float(np.mean(_squares(self.nothing.residual)) - np.mean(_squares(fit.residual)))

    def _learned(self, fit: Fit) -> tuple[LearnedResidual | None, float]:
        """Learn what is left over; None where it explains nothing of runs that it has not seen."""
        session = self.problem.session
        raw = self._raw(fit)
        residual, said = LearnedResidual.learn(session, raw, self.problem.whitener.spread, self.seed)
        whitened = self.problem.whitener(raw - torch.as_tensor(said)).numpy()
        more = float(np.mean(_squares(fit.residual)) - np.mean(_squares(whitened)))
        return (residual, more) if more > 0 else (None, 0.0)

    def _raw(self, fit: Fit) -> torch.Tensor:
        from swarmtwin.gap.motion import mean_displacement

        session = self.problem.session
        return residual_of(session, twist_of(mean_displacement(self.problem.base, fit.mechanisms, session.drive)))


def _squares(residual: np.ndarray) -> np.ndarray:
    return np.minimum(residual**2, 36.0)


def _finding(
    reference: Reference,
    measured: Recording,
    session: Session,
    held_out: np.ndarray,
    examination: _Examination,
    found: _Found,
    set_aside: int,
) -> Finding:
    left = tuple(test.part for test in found.after if test.found)
    mean_left = [part for part in left if part not in ("spread", "tails")]
    share = found.explained / max(found.achievable, 1e-9)
    still = max([test.explained for test in found.after if test.found and test.part in mean_left], default=0.0)
    gap = max(found.explained, 1e-9)
    causes_stand = bool(found.named.fit.mechanisms) and share >= LEAST_EXPLAINED_SHARE
    explained = causes_stand and (not mean_left or still < max(MOST_LEFT_OVER * gap, LEAST_LEFT_OVER))
    mechanisms: tuple[Mechanism, ...] = found.named.fit.mechanisms if causes_stand else ()
    noise_only = found.spread is not None and (explained or not found.named.fit.mechanisms)
    verdict: Verdict
    if explained or (noise_only and not mean_left):
        verdict = "explained"
    elif causes_stand or any(test.found for test in found.before) or found.named.fit.mechanisms:
        verdict = "unexplained"
    else:
        verdict = "no_gap"
    residual = found.residual if verdict == "unexplained" else None
    surroundings = session.drive.surroundings
    simulation = ExtendedDynamics(reference.base, (), surroundings)
    extended = ExtendedDynamics(reference.base, mechanisms, surroundings, residual) if mechanisms or residual else None
    causes = _causes(examination, found, mechanisms, share) if mechanisms else []
    if noise_only and found.spread:
        causes.append(_noise_cause(found.spread, bool(mechanisms)))
    plan, drive = _next_recording(examination, found, mechanisms)
    return _with_gains(
        reference, measured, session, held_out, simulation, extended, plan, drive, verdict, causes, found, left, set_aside,
        examination.seed,
    )


def _with_gains(
    reference: Reference,
    measured: Recording,
    session: Session,
    held_out: np.ndarray,
    simulation: ExtendedDynamics,
    extended: ExtendedDynamics | None,
    plan: NextRecording | None,
    drive: np.ndarray | None,
    verdict: Verdict,
    causes: list[Cause],
    found: _Found,
    left: tuple[str, ...],
    set_aside: int,
    seed: int,
) -> Finding:
    rng = np.random.default_rng(seed)
    unseen: Transitions = session.transitions.where(held_out)
    names = {unseen.runs[index] for index in np.unique(unseen.run)}
    tracks = [track for track in measured.tracks if track.run in names]
    loops_before: tuple[OpenLoop, ...] = tuple(open_loop(simulation, tracks))
    loops_after = tuple(open_loop(extended, tracks)) if extended else loops_before
    before = one_step_errors(simulation, unseen)
    after = one_step_errors(extended, unseen) if extended else before
    problem = Problem(reference.base, reference.noise, session)
    residual_before = problem.evaluate([]).residual
    residual_after = _standardised(problem, extended) if extended else residual_before
    mechanisms = extended.mechanisms if extended else ()
    extension = "none"
    if extended and extended.residual:
        extension = "mechanisms_and_learned_residual" if mechanisms else "learned_residual"
    elif extended:
        extension = "mechanisms"
    vehicles = tuple(session.transitions.vehicles[index] for index in np.unique(session.transitions.vehicle))
    diagnosis = Diagnosis(
        verdict=verdict,
        causes=tuple(causes),
        depends_on=tuple(test.part for test in found.before if test.found),
        gain=gains(before, after, unseen.run, loops_before, loops_after, rng),
        next_recording=plan,
        left_over=left if verdict != "no_gap" else (),
        tests=tuple(found.before),
        robot=reference.robot.name,
        vehicles=vehicles,
        runs={"fitted": session.runs - len(names), "held_out": len(names)},
        transitions={"used": len(session), "set_aside": set_aside},
        extension=extension,  # type: ignore[arg-type]
        seed=seed,
    )
    return Finding(
        diagnosis, simulation, extended, session.transitions, held_out, residual_before, residual_after,
        loops_before, loops_after, drive,
    )


def _standardised(problem: Problem, extended: ExtendedDynamics) -> np.ndarray:
    """Return (N, 3) the standardised residuals of an extended simulation."""
    if extended.residual is None:
        return problem.evaluate(extended.mechanisms).residual
    from swarmtwin.gap.motion import mean_displacement

    way = twist_of(mean_displacement(problem.base, extended.mechanisms, problem.session.drive))
    way = way + extended.residual.way(problem.session.drive)
    return problem.whitener(residual_of(problem.session, way)).numpy()


def _causes(examination: _Examination, found: _Found, mechanisms: tuple[Mechanism, ...], share: float) -> list[Cause]:
    named = found.named
    assert named.certainty is not None
    estimates = _estimates(examination, named.certainty, named.fit)
    total = sum(max(news, 1e-9) for news in named.news)
    causes = []
    for mechanism, parameters, news, rivals in zip(mechanisms, estimates, named.news, named.rivals, strict=True):
        confidence = _confidence(rivals, examination.rng)
        part = float(np.clip(share * max(news, 0.0) / total, 0.0, 1.0))
        evidence = (
            f"with it the measured motion is e^{news:.0f} times as likely on {examination.problem.session.runs} runs; "
            f"the next best cause in its place: {_next_best(rivals)}"
        )
        causes.append(
            Cause(
                name=mechanism.name,
                parameters=parameters,
                confidence=confidence,
                rivals=tuple(sorted(rivals, key=lambda name: rivals[name].sum())),
                share_of_gap=part,
                evidence=evidence,
            )
        )
    return sorted(causes, key=lambda cause: -cause.share_of_gap)


def _next_best(rivals: dict[str, np.ndarray]) -> str:  # type: ignore[type-arg]
    if not rivals:
        return "none comes near"
    name = min(rivals, key=lambda one: rivals[one].sum())
    return f"{name}, behind by {rivals[name].sum():.1f} nats"


def _confidence(rivals: dict[str, np.ndarray], rng: np.random.Generator) -> float:  # type: ignore[type-arg]
    """Return the share of resampled sessions in which no rival fits better."""
    if not rivals:
        return 1.0
    worse = np.stack(list(rivals.values()), axis=1)
    weights = rng.multinomial(len(worse), np.full(len(worse), 1 / len(worse)), BOOTSTRAPS)
    return float(((weights @ worse) > 0).all(axis=1).mean())


def _estimates(examination: _Examination, certainty: Certainty, fit: Fit) -> list[dict[str, Estimate]]:
    """Return for each mechanism its parameters as they are told, with 95 % intervals."""
    problem = examination.problem
    drawn = certainty.draws(BOOTSTRAPS, examination.rng)
    quantities = problem.quantities(fit.kinds)
    low = np.array([quantity.low for _, _, quantity in quantities])
    high = np.array([quantity.high for _, _, quantity in quantities])
    told = [problem.assembled(fit.kinds, values) for values in np.clip(drawn, low, high)] if len(quantities) else []
    estimates = []
    for index, mechanism in enumerate(fit.mechanisms):
        units = type(mechanism).units(problem.robot)
        values = mechanism.reported()
        own: dict[str, Estimate] = {}
        for name, value in values.items():
            samples = np.array([one[index].reported()[name] for one in told]) if told else np.array([value])
            if units[name] == "rad":
                samples = value + np.angle(np.exp(1j * (samples - value)))
            if not type(mechanism).quantities_of(problem.robot):
                samples = _observed(examination, mechanism, name)
            ends = np.quantile(samples, [0.025, 0.975])
            own[name] = Estimate(value=value, low=float(ends[0]), high=float(ends[1]), unit=units[name])
        estimates.append(own)
    return estimates


def _observed(examination: _Examination, mechanism: Mechanism, name: str) -> np.ndarray:
    """Return what resampled runs say of a parameter that is read off the clock."""
    session = examination.problem.session
    duration_s = session.transitions.duration_s
    period_s = session.drive.robot.period_s
    samples = []
    for _ in range(BOOTSTRAPS // 5):
        rows = examination.rng.integers(0, len(duration_s), len(duration_s))
        seen = type(mechanism).observed(duration_s[rows], period_s) or {}
        samples.append(seen.get(name, 0.0))
    return np.array(samples)


def _noise_cause(spread: Spread, is_second: bool) -> Cause:
    factor = Estimate(value=spread.factor, low=spread.low, high=spread.high, unit="")
    return Cause(
        name="noise_change",
        parameters={"factor": factor},
        confidence=1.0,
        rivals=(),
        share_of_gap=0.0 if is_second else 1.0,
        evidence=f"the random part of the motion is {abs(spread.errors):.0f} standard errors from the reference's; "
        "its mean is as it was, and the camera's share is told apart by how neighbouring residuals disagree",
    )


def _next_recording(
    examination: _Examination, found: _Found, mechanisms: tuple[Mechanism, ...]
) -> tuple[NextRecording | None, np.ndarray | None]:
    for index, rivals in enumerate(found.named.rivals if mechanisms else ()):
        if not rivals:
            continue
        name = min(rivals, key=lambda one: rivals[one].sum())
        others = [one for number, one in enumerate(mechanisms) if number != index]
        kind = examination.kinds[name]
        places = examination.problem.places(examination.nothing)
        from swarmtwin.gap.fitting import best_start

        rival = examination.problem.fit(best_start(examination.problem, kind, others, places)).mechanisms
        surroundings = examination.problem.surroundings
        plan, drive = separating_drive(
            examination.base, examination.reference.noise, surroundings, mechanisms, rival, examination.seed
        )
        return plan, drive
    return None, None


Progress = Callable[[str, int, int], None]
