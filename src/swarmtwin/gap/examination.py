"""The fitted runs of a session, looked at step by step: test, name, test again, learn what is left."""

from dataclasses import dataclass

import numpy as np
import torch

from swarmtwin.dynamics.twist import twist_of
from swarmtwin.gap.catalogue import offered
from swarmtwin.gap.dependence import Examined, dependences
from swarmtwin.gap.diagnosis import Dependence, Verdict
from swarmtwin.gap.fitting import Fit, Kind, Problem
from swarmtwin.gap.learned import LearnedResidual
from swarmtwin.gap.likeness import likeness
from swarmtwin.gap.mechanism import Mechanism
from swarmtwin.gap.mechanisms import noise_change
from swarmtwin.gap.motion import likeliest_displacement
from swarmtwin.gap.naming import Named, Report, Search, refitted
from swarmtwin.gap.noise import residual_of
from swarmtwin.gap.reference import Reference
from swarmtwin.gap.session import Session
from swarmtwin.gap.spread import Spread, compare_spread

MOST_SEARCHED = 6000
LEAST_EXPLAINED_SHARE = 0.7
MOST_LEFT_OVER = 0.06
LEAST_LEFT_OVER = 0.01
MOST_LEFT_BESIDE = 0.1
LARGEST_EXCESS = 0.4
LARGEST_SQUARE = 36.0
OF_SHAPE = ("spread", "tails")


@dataclass(frozen=True)
class Found:
    """What an examination says.

    Attributes:
        named: the causes that fit best.
        spread: how much more random the motion is, where that is all that is left and is news.
        before: tests of the simulation's residual.
        after: tests of what the causes leave.
        residual: what was learned of what they leave, None where nothing could be.
        explained: mean squared standardised residual that the causes take away.
        achievable: the same with the learned residual beside them.
    """

    named: Named
    spread: Spread | None
    before: list[Dependence]
    after: list[Dependence]
    residual: LearnedResidual | None
    explained: float
    achievable: float

    @property
    def share(self) -> float:
        """Share of what can be explained at all that the causes explain."""
        return float(np.clip(self.explained / max(self.achievable, 1e-9), 0.0, 1.0))

    @property
    def left_over(self) -> tuple[str, ...]:
        """What the residual still depends on, with the causes taken into account."""
        return tuple(test.part for test in self.after if test.found)

    @property
    def causes_stand(self) -> bool:
        """Whether the causes explain most of what can be explained: otherwise a name would be made up."""
        return bool(self.named.fit.mechanisms) and self.share >= LEAST_EXPLAINED_SHARE

    @property
    def left(self) -> float:
        """The largest part of the variance that goes with anything after the causes are taken into account."""
        return max([test.explained for test in self.after if test.found and test.part not in OF_SHAPE], default=0.0)

    @property
    def excess(self) -> float:
        """How much more variance is left than the reference has, as a share of it, where that is not a mere change."""
        if self.spread:
            return 0.0
        return max([test.explained for test in self.after if test.found and test.part == "spread"], default=0.0)

    @property
    def nothing_left(self) -> bool:
        """Whether what the causes leave is small beside what they explain."""
        most = max([MOST_LEFT_OVER, *(mechanism.leaves for mechanism in self.named.fit.mechanisms)])
        small = self.left < max(most * self.explained, LEAST_LEFT_OVER)
        return small and self.excess < LARGEST_EXCESS

    @property
    def are_named(self) -> bool:
        """Whether the causes are told: where much is left, a name may stand for what only looks like it."""
        several = len(self.named.fit.mechanisms) > 1
        beside = several and self.left < MOST_LEFT_BESIDE * self.explained and self.excess < LARGEST_EXCESS
        return self.causes_stand and (self.nothing_left or beside)

    @property
    def verdict(self) -> Verdict:
        """What to say."""
        if self.spread and not self.named.fit.mechanisms:
            return "explained"
        if self.causes_stand and self.nothing_left:
            return "explained"
        return "unexplained" if any(test.found for test in self.before) else "no_gap"

    @property
    def mechanisms(self) -> tuple[Mechanism, ...]:
        """The mechanisms that the simulation is extended by."""
        return self.named.fit.mechanisms if self.causes_stand and self.verdict != "no_gap" else ()


def _without_shape(tests: list[Dependence]) -> list[Dependence]:
    """Return tests of which spread and tails do not count: the camera's noise has changed, not the motion's."""
    return [test.model_copy(update={"found": test.found and test.part not in OF_SHAPE}) for test in tests]


class Examination:
    """Compares the runs of a session with a reference."""

    def __init__(self, reference: Reference, session: Session, seed: int, report: Report | None) -> None:
        self.reference, self.seed, self.report = reference, seed, report
        self.rng = np.random.default_rng(seed)
        self.base = reference.base
        self.problem = Problem(self.base, reference.noise, session, reference.vehicles)
        self.known = Problem(reference.unseen, reference.noise, reference.session)
        self.kinds: dict[str, Kind] = {
            name: kind
            for name, kind in offered(reference.robot, session.drive.surroundings).items()
            if kind is not noise_change.Config
        }
        self.nothing = self.problem.evaluate([])
        weight = likeness(session, reference.session)
        self._known_examined = Examined.of(self.known, self.known.evaluate([]), None, weight)

    def run(self) -> Found:
        """Test, name, test again, and learn what is left."""
        self._tell("tests")
        before = self._dependences(self.nothing)
        named = self._named()
        self._tell("what is left")
        after = self._dependences(named.fit) if named.fit.mechanisms else before
        explained = achievable = self._taken_away(self.nothing.residual, named.fit.residual)
        residual = None
        left = {test.part for test in after if test.found} - set(OF_SHAPE)
        if left:
            residual, more = self._learned(named.fit)
            achievable += more
        spread = None
        if not left and not any(kind.overrides("arriving") for kind in named.fit.kinds):
            compared = compare_spread(self.problem, named.fit, self.known, self.base, self.rng)
            spread = compared if compared.is_news else None
            if compared.is_none:
                before, after = (_without_shape(tests) for tests in (before, after))
        return Found(named, spread, before, after, residual, explained, achievable)

    def fitted(self, others: tuple[Mechanism, ...], name: str) -> tuple[Mechanism, ...]:
        """Return a mechanism of the catalogue fitted beside others."""
        beside = self.problem.evaluate(others)
        start = self.problem.promise(beside, self.kinds[name], self.problem.places(beside)).start
        return self.problem.fit(start).mechanisms

    def _tell(self, stage: str) -> None:
        if self.report:
            self.report(stage, 0, 1)

    def _dependences(self, fit: Fit) -> list[Dependence]:
        known = self._known_examined
        return dependences(Examined.of(self.problem, fit, self.base), known, self.seed, self.reference.forgives)

    def _named(self) -> Named:
        """Name the causes, on part of a long session first."""
        session = self.problem.session
        if len(session) <= MOST_SEARCHED:
            return self._search(self.problem)
        every = -(-len(session) // MOST_SEARCHED)
        part = session.where(session.run % every == 0)
        smaller = Problem(self.base, self.reference.noise, part, self.reference.vehicles)
        return refitted(self._search(smaller), self.problem, self.base)

    def _search(self, problem: Problem) -> Named:
        return Search(problem, self.known, self.base, self.kinds, self.reference.forgives, self.report).run()

    def _learned(self, fit: Fit) -> tuple[LearnedResidual | None, float]:
        """Learn what is left over; None where it explains nothing of runs that it has not seen."""
        session = self.problem.session
        way = twist_of(likeliest_displacement(self.problem.base, fit.mechanisms, session.drive))
        raw = residual_of(session, way)
        residual, said = LearnedResidual.learn(session, raw, self.problem.whitener.spread, self.seed)
        whitened = self.problem.whitener(raw - torch.as_tensor(said)).numpy()
        more = self._taken_away(fit.residual, whitened)
        return (residual, more) if more > 0 else (None, 0.0)

    @staticmethod
    def _taken_away(before: np.ndarray, after: np.ndarray) -> float:
        """Return by how much the mean square of standardised residuals falls, outliers cut."""
        squares = [float(np.minimum(residual**2, LARGEST_SQUARE).mean()) for residual in (before, after)]
        return squares[0] - squares[1]
