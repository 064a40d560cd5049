"""An oracle that knows all but the cause: the stand-in's own equations, its unit, its noise, its effects as physics.

What it makes of a session is the limit of what anyone can: the diagnosis has a learned simulation in the equations'
place, and mechanisms in that of the effects. Of the session itself it sees what a laboratory records, and a little
more: how large the camera's noise is, where a run began whose first picture is missing, and, where chance has heavy
tails, a twin of the session in which nothing hides.
"""

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from functools import cached_property

import numpy as np

from swarmtwin.diagnosis.settings import SearchSettings
from swarmtwin.standin.effect import Effect
from swarmtwin.studies.hidden_effects.baselines.oracle_causes import SupposedCause, jitter_nats
from swarmtwin.studies.hidden_effects.baselines.oracle_filter import Linearised, TrueLikelihood
from swarmtwin.studies.hidden_effects.baselines.oracle_fits import FittedSet, SetFits, Values
from swarmtwin.studies.hidden_effects.sessions import Truth


@dataclass(frozen=True)
class Oracle:
    """The search for the likeliest set of causes, by the true likelihood of each.

    From no cause on, the likeliest set is changed: a cause less, or one of those more that promise most beside it. A
    set's parameters are integrated out by Laplace's method, over uniform priors.

    Attributes:
        likelihood: of the session.
        settings: of the diagnosis' own search: the prior of a cause, and from what promise on it is fitted.
        most_causes: in a set.
        fitted_first: single causes that are fitted.
        fitted_further: causes that are fitted beside a set.
        most_changed: sets that are changed in turn.
        hopeless_nats: a set so far behind the likeliest one is not changed.
    """

    likelihood: TrueLikelihood
    settings: SearchSettings = field(default_factory=SearchSettings)
    most_causes: int = 4
    fitted_first: int = 6
    fitted_further: int = 4
    most_changed: int = 8
    hopeless_nats: float = 12.0

    @cached_property
    def fits(self) -> SetFits:
        """The fits of sets."""
        return SetFits(self.likelihood, self.settings, self.hopeless_nats)

    def named(self, outside: Sequence[Effect] = ()) -> dict[str, dict[str, float]]:
        """Return the causes of the likeliest set with their parameters, none where nothing is likeliest.

        `outside` is what hides in the session and is in no catalogue, which the oracle supposes beside the catalogue's
        sets, with its true parameters and the prior of one cause: where it is likelier than they are, nothing is named.
        """
        best = self.likeliest()
        if outside and self.fits.of_no_catalogue(outside) > best.nats:
            return {}
        causes = self.fits.causes
        told = {name: dict(causes[name].named(values)) for name, values in best.values.items()}
        return {name: {key: float(one) for key, one in own.items()} for name, own in told.items()} | self._jitter()

    def _jitter(self) -> dict[str, dict[str, float]]:
        """Return the cause that the clock shows by itself, where it does."""
        driven, character = self.likelihood.driven, self.likelihood.driven.session.conditions.character
        duration_s, period_s = np.diff(driven.time_s), driven.session.robot.period_s
        nats = jitter_nats(duration_s, period_s, character.jitter)
        if nats + math.log(self.settings.prior / (1 - self.settings.prior)) <= 0:
            return {}
        return {"timing_jitter": {"spread": float(np.std(duration_s / period_s))}}

    def likeliest(self) -> FittedSet:
        """Return the likeliest set of causes: the likeliest that was not yet changed is, until none can be better.

        What took the place of causes not yet found, more noise above all, is left out again.
        """
        nothing = self.fits.fit({})
        tried, changed = {frozenset[str](): nothing}, set[frozenset[str]]()
        for _ in range(self.most_changed):
            best = max(one.nats for one in tried.values())
            left = [one for names, one in tried.items() if names not in changed and self._may_lead(one, best)]
            if not left:
                break
            chosen = max(left, key=lambda one: one.nats)
            changed.add(frozenset(chosen.values))
            for start in self._changes(chosen):
                known = tried.get(frozenset(start))
                if known is None or self._begins_better(start, chosen.linear, known):
                    best = max(one.nats for one in tried.values())
                    fits = [self.fits.fit(start, best), *([known] if known else [])]
                    tried[frozenset(start)] = max(fits, key=lambda one: one.nats)
        return max(tried.values(), key=lambda one: one.nats)

    def _begins_better(self, start: Values, linear: Linearised, known: FittedSet) -> bool:
        """Return whether a set that was fitted is likelier already where it would begin anew."""
        return bool(start) and self.fits.evaluate(start, linear).nats.sum() > known.here.nats.sum() + 0.5

    def _may_lead(self, fitted: FittedSet, best: float) -> bool:
        """Return whether a set is near enough to the likeliest one to be changed."""
        return fitted.nats > best - self.hopeless_nats

    def _changes(self, fitted: FittedSet) -> Iterator[Values]:
        """Yield sets with a cause less, then with one more, where they begin."""
        if len(fitted.values) > 1:
            for name in fitted.values:
                yield {each: values for each, values in fitted.values.items() if each != name}
        if len(fitted.values) < self.most_causes:
            most = self.fitted_further if fitted.values else self.fitted_first
            for name, start in self.promising(fitted)[:most]:
                yield fitted.values | {name: start}

    def promising(self, fitted: FittedSet) -> list[tuple[str, np.ndarray]]:
        """Return causes that would make the session likelier beside a set, the best first, each where it begins."""
        promises: list[tuple[float, str, np.ndarray]] = []
        for name, cause in self.fits.causes.items():
            if name in fitted.values:
                continue
            best, start = max((self._promise(fitted, cause, values) for values in cause.tried), key=lambda one: one[0])
            if best > self.settings.least_promise:
                promises.append((best, name, start))
        promises.sort(key=lambda one: -one[0])
        return [(name, start) for _, name, start in promises]

    def _promise(self, fitted: FittedSet, cause: SupposedCause, values: np.ndarray) -> tuple[float, np.ndarray]:
        """Return the nats that a cause promises, and where to begin: at `values`, or scaled along them."""
        there = self.fits.evaluate(fitted.values | {cause.name: values}, fitted.linear)
        direct = float(there.nats.sum() - fitted.here.nats.sum())
        if cause.scaled is None:
            return direct, values
        change = there.surprise - fitted.here.surprise
        size = float(change @ change) + 1e-12
        share = -float(change @ fitted.here.surprise) / size
        scaled = values.copy()
        scaled[cause.scaled] = cause.nothing + share * (values[cause.scaled] - cause.nothing)
        scaled = np.clip(scaled, cause.low, cause.high)
        moved = (scaled[cause.scaled] - cause.nothing) / (values[cause.scaled] - cause.nothing)
        expected = size * (share * moved - 0.5 * moved**2)
        return (expected, scaled) if expected > direct else (direct, values)


def oracle_causes(truth: Truth) -> dict[str, dict[str, float]]:
    """Return what the oracle names in a session whose equations it knows."""
    measured, twin = truth.measured, truth.twin
    likelihood = TrueLikelihood.of(measured.footage, measured.recording)
    likelihood = likelihood.with_tails_of(TrueLikelihood.of(twin.footage, twin.recording))
    outside = measured.footage.session.effects if truth.case.kind == "outside" else ()
    return Oracle(likelihood).named(outside)
