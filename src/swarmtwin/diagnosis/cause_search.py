"""Step 3. Which sets of causes make a session likely: the best of all are fitted, and share the probability."""

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from itertools import combinations

import numpy as np

from swarmtwin.diagnosis.estimated_set import EstimatedSet
from swarmtwin.diagnosis.estimation import SHORT_STEP, Progress, estimate
from swarmtwin.diagnosis.likelihood import MechanismClass, SessionLikelihood, loses_commands
from swarmtwin.diagnosis.reference_errors import ReferenceErrors
from swarmtwin.diagnosis.screening import Candidate, best_by_name, candidates, pairs
from swarmtwin.diagnosis.settings import SearchSettings
from swarmtwin.simulation.mechanism import Mechanism


def prior_log_odds(settings: SearchSettings) -> float:
    """Return the log of the odds against a cause beforehand."""
    return math.log((1 - settings.prior) / settings.prior)


def too_little_nats(settings: SearchSettings, transitions: int) -> float:
    """Return by how many nats a cause changes a session's likelihood that is too small to matter."""
    return settings.least_nats_a_transition * transitions


def is_of_exact_form(model: SessionLikelihood, kind: MechanismClass) -> bool:
    """Say whether there is no other form of a mechanism that what it gains could come from.

    Of one that the clock shows nothing is fitted; and which commands were lost is summed over: each arrives or does
    not, and what follows is what the simulation does. How thrust goes on as it did before, that knows less well.
    """
    return bool(model.read_off_clock(kind)) or (loses_commands([kind]) and model.robot.actuation.kind != "thrust")


def share_beside(settings: SearchSettings, model: SessionLikelihood, kinds: Sequence[MechanismClass]) -> float:
    """Return the share of what a set of causes gains that is no evidence for those beyond the first.

    No form is exact, least of all that of how thrust follows; but for those of which there is no other.
    """
    fitted = [kind for kind in kinds if not is_of_exact_form(model, kind)]
    late = sum(kind.says_when for kind in fitted) if model.robot.actuation.kind == "thrust" else 0
    beside, beside_late = max(len(fitted) - 1, 0), max(late - 1, 0)
    return settings.least_share_beside * (beside - beside_late) + settings.least_share_late * beside_late


@dataclass(frozen=True)
class CausePosterior:
    """Sets of causes with their evidence.

    Attributes:
        sets: all that were fitted, the most probable first.
        log_probability: of each, normalised over them.
        nothing: the set of no cause.
        log_odds_against: of each set beforehand, what is too little to matter included: nats.
    """

    sets: tuple[EstimatedSet, ...]
    log_probability: np.ndarray
    nothing: EstimatedSet
    log_odds_against: np.ndarray

    @property
    def best(self) -> EstimatedSet:
        """The most probable set."""
        return self.sets[0]

    def probability(self, *names: str) -> float:
        """Return the probability that one of some causes is there, at least, summed over sets."""
        own = [any(name in one.names for name in names) for one in self.sets]
        return min(float(np.exp(self.log_probability)[own].sum()), 1.0)

    @property
    def of_any(self) -> float:
        """Return the probability that any cause is there."""
        return self.probability(*{name for one in self.sets for name in one.names})

    def rivals(self, name: str, least: float) -> tuple[str, ...]:
        """Return the causes that share the probability with one: in sets without it, and not beside it in the best."""
        shared: dict[str, float] = {}
        for one, log in zip(self.sets, self.log_probability, strict=True):
            if name not in one.names:
                for other in one.names:
                    if other not in self.best.names:
                        shared[other] = shared.get(other, 0.0) + float(np.exp(log))
        return tuple(sorted((other for other, held in shared.items() if held >= least), key=lambda o: -shared[o]))

    def by_names(self) -> list[tuple[tuple[str, ...], float, float]]:
        """Return each set of names with its probability and its log evidence over nothing, the most probable first.

        Sets of the same names, whose causes take other forms, are one: their probabilities add up, and the evidence is
        the mean over the forms.
        """
        together: dict[frozenset[str], list[int]] = {}
        for number, one in enumerate(self.sets):
            together.setdefault(frozenset(one.names), []).append(number)
        logs, evidence = (
            {key: float(np.logaddexp.reduce(values[forms])) for key, forms in together.items()}
            for values in (self.log_probability, self.log_probability + self.log_odds_against)
        )
        nothing = evidence[frozenset()]
        return [
            (self.sets[together[key][0]].names, math.exp(logs[key]), evidence[key] - nothing)
            for key in sorted(logs, key=lambda key: -logs[key])
        ]

    def of_names(self, names: Sequence[str]) -> EstimatedSet | None:
        """Return the most probable set of just these causes; None where none was fitted."""
        return next((one for one in self.sets if set(one.names) == set(names)), None)

    def is_likelier_than_nothing(self, names: Sequence[str]) -> bool:
        """Return whether a set of just these causes was fitted and is more probable than that of none."""
        log = {
            frozenset(one.names): float(own)
            for one, own in zip(self.sets[::-1], self.log_probability[::-1], strict=True)
        }
        return log.get(frozenset(names), -math.inf) > log[frozenset()]


class _OncePerFit:
    """Remembers what was said of the last fit of each set of causes: it costs evaluations of the likelihood."""

    def __init__(self, asked: Callable[[EstimatedSet], float]) -> None:
        self._asked = asked
        self._known: dict[tuple[MechanismClass, ...], tuple[EstimatedSet, float]] = {}

    def of(self, one: EstimatedSet) -> float:
        """Return it for a fitted set."""
        kinds = one.fitted.kinds
        if kinds not in self._known or self._known[kinds][0] is not one:
            self._known[kinds] = one, self._asked(one)
        return self._known[kinds][1]


class CauseSearch:
    """Looks for the sets of causes that share the probability.

    Args:
        model: of the session.
        kinds: the mechanisms offered, by name.
        progress: called with what is being tried.
        reference: what its own errors show: commands that seem to be lost there as well; None: nothing.
        screened: of some of the session's runs, in which mechanisms are screened and sets first fitted; None: of all.
        enough: a step towards the likeliest values is the last one where it is shorter, in standard deviations.
    """

    def __init__(
        self,
        model: SessionLikelihood,
        kinds: Mapping[str, MechanismClass],
        progress: Progress | None = None,
        reference: ReferenceErrors | None = None,
        screened: SessionLikelihood | None = None,
        enough: float = SHORT_STEP,
    ) -> None:
        self._in_part, self._enough = self, enough
        if screened is not None and screened is not model:
            self._in_part = CauseSearch(screened, kinds, None, reference, enough=0.5)  # an eighth of a nat
        self._reference = reference or ReferenceErrors()
        self.model, self.settings, self.progress = model, model.settings.search, progress
        self.kinds = model.shown_of(kinds)
        self.fitted: dict[frozenset[MechanismClass], EstimatedSet] = {}
        self._alone: list[Candidate] = []
        self._shares, self._usual_gains = _OncePerFit(self._shares_of_evidence), _OncePerFit(self._gained_by_usual_loss)

    def run(self) -> CausePosterior:
        """Fit sets of one cause more at a time, beside the best ones, until a further cause is not probable."""
        nothing = self._fit(())
        frontier, best = [nothing], self.score(nothing)
        for count in range(1, self.settings.most_causes + 2):  # one more shows where these do not suffice
            for start in self._starts(frontier, count):
                self._fit(start)
            kept = self._of_size(count)[: self.settings.kept_sets]
            frontier = sorted(map(self._polished, kept), key=self.score, reverse=True)
            if not frontier or self.score(frontier[0]) < best:
                break
            best = self.score(frontier[0])
        self._drop_one()
        self._fit_parts_of_best()
        return self._posterior(nothing)

    def _starts(self, frontier: Sequence[EstimatedSet], count: int) -> list[tuple[Mechanism, ...]]:
        """Return where fits of sets of `count` causes begin, and of pairs at first: as far as they promise anything."""
        screened = self._in_part.model
        promise = self._least_promise() * len(screened.session) / len(self.model.session)
        proposed: list[Candidate] = []
        for number, one in enumerate(frontier):
            self._tell(f"{count} causes", number, len(frontier))
            beside = screened.evaluate(one.mechanisms)
            found = candidates(screened, beside, self.kinds, self._alone)
            proposed += best_by_name(screened, beside, found, self.settings.fitted_a_set)
            if count == 1:
                proposed += pairs(screened, beside, found, self.settings.fitted_pairs)
                self._alone = found
        starts = [candidate.start for candidate in proposed if candidate.nats > promise]
        return starts if self._in_part is self else self._in_part.likely_starts(starts)

    def _least_promise(self) -> float:
        """Return the nats of the whole session below which nothing is fitted.

        Where other units may differ, only a share of what a cause changes is evidence, and less of it is enough.
        """
        if self.model.unknown_vehicles:
            return self.settings.least_promise
        matters = too_little_nats(self.settings, len(self.model.session))
        return max(self.settings.least_promise, self.settings.least_promise_share * matters)

    def likely_starts(self, starts: Sequence[tuple[Mechanism, ...]]) -> list[tuple[Mechanism, ...]]:
        """Return sets with the values that are likeliest here, of those that are not far less probable than the best.

        That is, than the best of their size; of a size of which all are so beside the best smaller set, none.
        """
        proposed, settings = {_kinds(start) for start in starts}, self.settings
        for start in starts:
            self._fit(start)
        likely = []
        for size in sorted({len(kinds) for kinds in proposed}):
            ordered, smaller = self._of_size(size), [one for one in self.fitted.values() if len(one.names) < size]
            best = self.score(ordered[0])
            if best < max(map(self.score, smaller), default=-math.inf) - settings.most_behind:
                continue
            for place, one in enumerate(ordered):
                is_near = place < settings.kept_sets or self.score(one) >= best - settings.most_behind
                if is_near and _kinds(one.mechanisms) in proposed:
                    likely.append(one.mechanisms)
        return likely

    def _of_size(self, count: int) -> list[EstimatedSet]:
        """Return the sets of so many causes that were fitted, the most probable first."""
        sized = [one for one in self.fitted.values() if len(one.names) == count]
        return sorted(sized, key=self.score)[::-1]

    def score(self, one: EstimatedSet) -> float:
        """Return the log of evidence times prior, all forms of a cause equally probable beforehand."""
        forms = sum(math.log(len(kind.forms(self.model.robot))) for kind in one.fitted.kinds)
        return one.evidence - forms - self._usual_gains.of(one) - self._log_odds_against(one)

    def _log_odds_against(self, one: EstimatedSet) -> float:
        """Return the log of a set's odds beforehand, each cause's gain counted from where it begins to matter.

        A further cause begins to matter where it gains more than what another form of those beside it would.
        """
        count, gained = len(one.names), one.evidence - self._exact_part(one).evidence
        further = share_beside(self.settings, self.model, one.fitted.kinds) * max(gained, 0.0)
        too_little = too_little_nats(self.settings, len(self.model.session)) * self._shares.of(one)
        return count * prior_log_odds(self.settings) + too_little + further

    def _exact_part(self, one: EstimatedSet) -> EstimatedSet:
        """Return what was fitted of a set's causes without another form alone; of none where that was not."""
        exact = frozenset(kind for kind in one.fitted.kinds if is_of_exact_form(self.model, kind))
        return self.fitted.get(exact) or self._fit(())

    def _shares_of_evidence(self, one: EstimatedSet) -> float:
        """Return the sum over a set's causes of the share of what each changes that is evidence, and no unit's own.

        What matters is what a cause changes beside the others, and little of that is evidence where other units may
        differ by as much. A cause that a unit makes up for takes nothing off what is asked of the others.
        """
        if not self.model.unknown_vehicles:
            return float(len(one.names))
        return sum(self._share_of_evidence(one, cause) for cause in one.mechanisms)

    def _share_of_evidence(self, one: EstimatedSet, cause: Mechanism) -> float:
        beside = self.model.evaluate([other for other in one.mechanisms if other is not cause])
        changed = ((one.fitted.whitened - beside.whitened) ** 2).sum(axis=1) @ self.model.weight / 2
        return min(max(one.fitted.total - beside.total, 0.0) / changed, 1.0) if changed > 0 else 1.0

    def _gained_by_usual_loss(self, one: EstimatedSet) -> float:
        """Return the nats that a set with lost commands gains by as many as the reference seems to lose: no news."""
        if not loses_commands(one.fitted.kinds):
            return 0.0
        usual, none = (self._with_loss(one, share) for share in (self._reference.loss, 0.0))
        if usual == none:
            return 0.0
        return max(self.model.evaluate(usual).total - self.model.evaluate(none).total, 0.0)

    @staticmethod
    def _with_loss(one: EstimatedSet, share: float) -> list[Mechanism]:
        """Return a set's mechanisms, those that lose commands losing a share of them."""
        return [
            type(each).at(dict.fromkeys(each.values(), share)) if loses_commands([type(each)]) else each
            for each in one.mechanisms
        ]

    def _fit(self, start: Sequence[Mechanism]) -> EstimatedSet:
        """Fit a set, anew where it was fitted before and is likelier already where it would begin now."""
        key = _kinds(start)
        known = self.fitted.get(key)
        if known is None or (start and self.model.evaluate(start).total > known.fitted.total + 0.5):
            found = estimate(self.model, start, enough=self._enough)
            if known is None or self.score(found) > self.score(known):
                self.fitted[key] = found
        return self.fitted[key]

    def _polished(self, one: EstimatedSet) -> EstimatedSet:
        """Search a little around a set's values where the motion changes by jumps: others begin from there."""
        if not all(kind.is_smooth for kind in one.fitted.kinds) and not loses_commands(one.fitted.kinds):
            found = estimate(self.model, one.mechanisms, polish=True)
            if self.score(found) > self.score(one):
                self.fitted[_kinds(one.mechanisms)] = found
                return found
        return one

    def _drop_one(self) -> None:
        """Fit what is left of the best set when single causes are taken out of it, until none of that is better.

        It is fitted anew from the best set's values where it was fitted before: from a coarse grid it may have ended
        elsewhere, and another cause then seemed to be needed.
        """
        while True:
            best = max(self.fitted.values(), key=self.score)
            for name in best.names:
                left = [one for one in best.mechanisms if one.name != name]
                key, again = _kinds(left), estimate(self.model, left, polish=True)
                if key not in self.fitted or self.score(again) > self.score(self.fitted[key]):
                    self.fitted[key] = again
            if max(self.fitted.values(), key=self.score) is best:
                return

    def _fit_parts_of_best(self) -> None:
        """Fit what was not fitted of the best set's parts, until it stays the best: they are asked about by name."""
        while True:
            best = max(self.fitted.values(), key=self.score)
            for size in range(1, len(best.names)):
                for part in combinations(best.mechanisms, size):
                    if _kinds(part) not in self.fitted:
                        self._fit(part)
            if max(self.fitted.values(), key=self.score) is best:
                return

    def _posterior(self, nothing: EstimatedSet) -> CausePosterior:
        ordered = sorted(self.fitted.values(), key=self.score, reverse=True)
        scores = np.array([self.score(one) for one in ordered])
        logs = scores - np.logaddexp.reduce(scores)
        return CausePosterior(tuple(ordered), logs, nothing, np.array([self._log_odds_against(one) for one in ordered]))

    def _tell(self, stage: str, done: int, whole: int) -> None:
        if self.progress:
            self.progress(stage, done, whole)


def _kinds(mechanisms: Sequence[Mechanism]) -> frozenset[MechanismClass]:
    """Return which mechanisms these are, in which forms."""
    return frozenset(type(one) for one in mechanisms)
