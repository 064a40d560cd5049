"""Causes are named one after the other: the best is added, then each is tried against every other one."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from swarmtwin.gap.base import AnyBase
from swarmtwin.gap.certainty import Certainty, certainty
from swarmtwin.gap.fitting import Fit, Kind, Problem, Promise
from swarmtwin.gap.likeness import likeness
from swarmtwin.gap.mechanism import Mechanism

MOST_CAUSES = 4
FEWEST_NATS = 15.0
FEWEST_NATS_A_TRANSITION = 0.006
PENALTY_WEIGHT = 2.0
EXCHANGE_NATS = 3.0
RIVAL_NATS = 4.0
NATS_A_PARAMETER = 4.0
LARGEST_Z = 5.0
LEAST_SHARE = 0.04
RIVAL_ERRORS = 2.5
SEARCH_NATS = 8.0
LEAST_ERRORS, FEWER_ERRORS = 4.0, 2.3
LARGE = 3.0
PROMISE = 0.35
EXCHANGE_PROMISE = 0.5

Report = Callable[[str, int, int], None]


@dataclass(frozen=True)
class Named:
    """The causes found in a session.

    Attributes:
        fit: the mechanisms with their values.
        certainty: of these values.
        news: (number of causes,) nats by which each one is missed when it is left out, penalties taken off.
        rivals: for each cause, those that fit in its place nearly as well, with what their fit is worse by, (R,) nats.
    """

    fit: Fit
    certainty: Certainty | None
    news: tuple[float, ...]
    rivals: tuple[Mapping[str, np.ndarray], ...]


class Search:
    """A search for the causes in one session.

    Args:
        problem: the session.
        known: the reference's own transitions, answered by what has not seen them: what improves these as well is a
            weakness of the simulation, and no news.
        base: the simulation.
        kinds: the mechanisms offered, by name.
        forgives: whether that is so.
        report: called with what is being tried, and how far it is.
    """

    def __init__(
        self,
        problem: Problem,
        known: Problem,
        base: AnyBase,
        kinds: Mapping[str, Kind],
        forgives: bool = True,
        report: Report | None = None,
    ) -> None:
        self.problem, self.known, self.base = problem, known, base
        self.kinds = {name: kind for name, kind in kinds.items() if problem.offers(kind)}
        self.forgives, self.report = forgives, report
        self._fits: dict[frozenset[str], Fit] = {}
        self._promises: dict[frozenset[str], dict[str, Promise]] = {}
        self._changes: dict[str, np.ndarray] = {}
        self._nothing = problem.evaluate([])
        self._known_nothing = known.evaluate([])
        self._like_known = likeness(problem.session, known.session)
        self.least = max(FEWEST_NATS, FEWEST_NATS_A_TRANSITION * len(problem.session))

    def run(self) -> Named:
        """Add the best cause, exchange what fits better otherwise, drop what is not needed; until nothing helps."""
        chosen = self._nothing
        for _ in range(MOST_CAUSES):
            better = self._exchanged(self._grown(chosen))
            if better is None or len(better.mechanisms) <= len(chosen.mechanisms):
                break
            chosen = better
        chosen = self._pruned(chosen)
        if not chosen.mechanisms:
            return Named(chosen, None, (), ())
        news = tuple(self._news(chosen, self._without(chosen, index)) for index in range(len(chosen.mechanisms)))
        rivals = tuple(self._rivals(chosen, index) for index in range(len(chosen.mechanisms)))
        return Named(chosen, certainty(self.problem, self.base, chosen), news, rivals)

    def _fit(self, beside: Fit, kind: Kind) -> Fit:
        """Fit a mechanism together with those of a fit, from where these are."""
        name = kind.model_fields["name"].default
        key = frozenset([*beside.names, name])
        if key not in self._fits:
            self._fits[key] = self.problem.fit(self._promised(beside)[name].start)
        return self._fits[key]

    def _promised(self, fit: Fit) -> dict[str, Promise]:
        """Return what each mechanism promises beside a fit."""
        key = frozenset(fit.names)
        if key not in self._promises:
            places = self.problem.places(fit)
            self._promises[key] = {
                name: self.problem.promise(fit, kind, places)
                for name, kind in self.kinds.items()
                if name not in fit.names
            }
        return self._promises[key]

    def _promising(self, fit: Fit, needed: float) -> list[str]:
        """Return the mechanisms that could gain so many nats beside a fit, the most promising first."""
        promised = self._promised(fit)
        return sorted(
            (name for name in promised if promised[name].nats > needed), key=lambda name: -promised[name].nats
        )

    def _grown(self, chosen: Fit) -> Fit | None:
        """Return the best fit with one mechanism more, None where none is worth it."""
        best, most = None, self.least
        promised = self._promised(chosen)
        names = self._promising(chosen, PROMISE * self.least)
        for number, name in enumerate(names):
            if self.report:
                self.report(f"cause {len(chosen.mechanisms) + 1}", number, len(names))
            needed = max(most, self._needed_beside(chosen, promised[name].change))
            if promised[name].nats < PROMISE * needed:
                continue
            found = self._fit(chosen, self.kinds[name])
            if found.total - chosen.total > needed and (news := self._news(found, chosen)) > needed:
                best, most = found, news
        return best

    def _needed_beside(self, chosen: Fit, change: np.ndarray) -> float:
        """Return the nats that a further cause must bring: the more, the more it looks like one already named.

        A mechanism is never exact. What it leaves is like itself, and must not be taken for a second cause.
        """
        needed = LEAST_SHARE * (chosen.total - self._nothing.total)
        for index, mechanism in enumerate(chosen.mechanisms):
            if mechanism.name not in self._changes:
                alone = self.problem.evaluate([mechanism])
                self._changes[mechanism.name] = (alone.residual - self._nothing.residual).ravel()
            other = self._changes[mechanism.name]
            size = float(np.linalg.norm(change) * np.linalg.norm(other))
            alike = abs(float(change @ other)) / max(size, 1e-12)
            gained = chosen.total - self._without(chosen, index).total
            needed = max(needed, mechanism.leaves * alike * gained)
        return needed

    def _exchanged(self, chosen: Fit | None) -> Fit | None:
        """Exchange single mechanisms as long as another one fits better in their place."""
        if chosen is None or len(chosen.mechanisms) < 2:
            return chosen
        for _ in range(len(chosen.mechanisms) + 1):
            better = self._best_exchange(chosen)
            if better is None:
                return chosen
            chosen = better
        return chosen

    def _best_exchange(self, chosen: Fit) -> Fit | None:
        best = None
        for index in range(len(chosen.mechanisms)):
            others = self._without(chosen, index)
            for name in self._promising(others, EXCHANGE_PROMISE * (chosen.total - others.total)):
                if name in chosen.names:
                    continue
                found = self._fit(others, self.kinds[name])
                standing = best or chosen
                more = len(self.problem.values(found.mechanisms)) - len(self.problem.values(standing.mechanisms))
                needed = self._needed_beside(others, self._promised(others)[name].change)
                if found.total - others.total < needed:
                    continue
                if found.total > standing.total + EXCHANGE_NATS + max(more, 0):
                    best = found
        return best

    def _pruned(self, chosen: Fit) -> Fit:
        """Drop mechanisms that the others make superfluous."""
        while len(chosen.mechanisms) > 1:
            left = [self._without(chosen, index) for index in range(len(chosen.mechanisms))]
            news = [self._news(chosen, fit) for fit in left]
            if min(news) > self.least:
                return chosen
            chosen = left[int(np.argmin(news))]
        return chosen

    def _without(self, chosen: Fit, index: int) -> Fit:
        others = [one for number, one in enumerate(chosen.mechanisms) if number != index]
        key = frozenset(other.name for other in others)
        if key not in self._fits:
            self._fits[key] = self.problem.fit(others)
        return self._fits[key]

    def _news(self, larger: Fit, smaller: Fit) -> float:
        """Return the nats that a fit is better by than a smaller one, as far as that is news and not chance."""
        gained = larger.total - smaller.total
        added = [mechanism for mechanism in larger.mechanisms if mechanism.name not in smaller.names]
        already = self._already(added, larger, smaller)
        penalty = certainty(self.problem, self.base, larger).penalty
        if smaller.mechanisms:
            penalty -= certainty(self.problem, self.base, smaller).penalty
        searched = SEARCH_NATS * sum(not mechanism.is_smooth for mechanism in added)
        by_run = self.problem.session.by_run(larger.likelihood - smaller.likelihood)
        errors = by_run.sum() / max(by_run.std() * np.sqrt(len(by_run)), 1e-9)
        if errors < (LEAST_ERRORS if gained < LARGE * self.least else FEWER_ERRORS):
            return -np.inf
        return gained - already - PENALTY_WEIGHT * max(penalty, 0.0) - searched

    def _already(self, added: Sequence[Mechanism], larger: Fit, smaller: Fit) -> float:
        """Return the nats of a gain that the reference would show as well: there the simulation is weak, no more.

        Where mechanisms would change the reference's residuals by d, they go along with d by a slope α, 0 if nothing is
        wrong with the simulation. As far as that is so, α Σ d² nats of the session's gain are no news.
        """
        if not self.forgives:
            return 0.0
        known = self.known.evaluate(added)
        if any(mechanism.overrides("arriving") for mechanism in added):
            return max(0.0, float((known.likelihood - self._known_nothing.likelihood) @ self._like_known))
        change = (self._known_nothing.residual - known.residual).clip(-LARGEST_Z, LARGEST_Z)
        along = (self._known_nothing.residual.clip(-LARGEST_Z, LARGEST_Z) * change).sum(axis=1)
        size = float((change**2).sum())
        by_run = self.known.session.by_run(along)
        slope = (float(along.sum()) + float(by_run.std()) * np.sqrt(len(by_run))) / max(size, 1e-9)
        here = (smaller.residual - larger.residual).clip(-LARGEST_Z, LARGEST_Z) / larger.scale
        return max(slope, 0.0) * float((here**2).sum()) if size > 0 else 0.0

    def _rivals(self, chosen: Fit, index: int) -> dict[str, np.ndarray]:
        """Return by name what fits nearly as well in the place of a cause, and by how much less in each run, (R,)."""
        others = self._without(chosen, index)
        found = {}
        for name in self._promising(others, EXCHANGE_PROMISE * (chosen.total - others.total)):
            if name in chosen.names:
                continue
            rival = self._fit(others, self.kinds[name])
            more = len(self.problem.values(rival.mechanisms)) - len(self.problem.values(chosen.mechanisms))
            worse = self.problem.session.by_run(chosen.likelihood - rival.likelihood)
            worse += NATS_A_PARAMETER * more / len(worse)
            error = worse.std() * np.sqrt(len(worse))
            if worse.sum() < max(RIVAL_NATS, RIVAL_ERRORS * error):
                found[name] = worse
        return found


def refitted(named: Named, problem: Problem, base: AnyBase) -> Named:
    """Return the same causes with values fitted to another, larger session."""
    if not named.fit.mechanisms:
        return replace(named, fit=problem.evaluate([]))
    fit = problem.fit(named.fit.mechanisms)
    return replace(named, fit=fit, certainty=certainty(problem, base, fit))
