"""An oracle that knows all but the cause: the stand-in's own equations, its unit, its noise, its effects as physics.

What it makes of a session is the limit of what anyone can: the diagnosis has a learned simulation in the equations'
place, and mechanisms in that of the effects. It sees what a laboratory records, and no more of the session itself.
"""

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field

import numpy as np

from swarmtwin.diagnosis.settings import SearchSettings
from swarmtwin.standin.effect import Effect
from swarmtwin.studies.hidden_effects.baselines.oracle_causes import (
    SupposedCause,
    jitter_nats,
    prior_nats,
    supposed_causes,
)
from swarmtwin.studies.hidden_effects.baselines.oracle_filter import Linearised, TrueLikelihood
from swarmtwin.studies.hidden_effects.baselines.oracle_follower import Evaluation
from swarmtwin.studies.hidden_effects.sessions import Truth

Values = dict[str, np.ndarray]
"""Of each cause of a set its parameters (P,)."""


@dataclass(frozen=True)
class FittedSet:
    """A set of causes at its likeliest parameters.

    Attributes:
        values: of each cause its parameters, in the order in which causes were found.
        linear: how chance enters there.
        here: the session there.
        nats: log of the posterior probability, but for a constant of all sets.
    """

    values: Values
    linear: Linearised
    here: Evaluation
    nats: float


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
        rounds: of Fisher's scoring.
        hope: for more nats, over what a quadratic likelihood would gain twice, before a fit is given up.
    """

    likelihood: TrueLikelihood
    settings: SearchSettings = field(default_factory=SearchSettings)
    most_causes: int = 4
    fitted_first: int = 6
    fitted_further: int = 4
    most_changed: int = 8
    hopeless_nats: float = 12.0
    rounds: int = 8
    hope: float = 2.0

    def named(self, outside: Sequence[Effect] = ()) -> dict[str, dict[str, float]]:
        """Return the causes of the likeliest set with their parameters, none where nothing is likeliest.

        `outside` is what hides in the session and is in no catalogue, which the oracle supposes beside the catalogue's
        sets, with its true parameters and the prior of one cause: where it is likelier than they are, nothing is named.
        """
        best = self.likeliest()
        if outside and self._of_no_catalogue(outside) > best.nats:
            return {}
        causes = self.causes
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

    @property
    def causes(self) -> dict[str, SupposedCause]:
        """All that may hide."""
        session = self.likelihood.driven.session
        return supposed_causes(session.robot, len(session.vehicles), session.conditions.character.delay_s)

    def likeliest(self) -> FittedSet:
        """Return the likeliest set of causes: the likeliest that was not yet changed is, until none can be better.

        What took the place of causes not yet found, more noise above all, is left out again.
        """
        nothing = self.fit({})
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
                    fits = [self.fit(start, best), *([known] if known else [])]
                    tried[frozenset(start)] = max(fits, key=lambda one: one.nats)
        return max(tried.values(), key=lambda one: one.nats)

    def _begins_better(self, start: Values, linear: Linearised, known: FittedSet) -> bool:
        """Return whether a set that was fitted is likelier already where it would begin anew."""
        return bool(start) and self._evaluate(start, linear).nats.sum() > known.here.nats.sum() + 0.5

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
        for name, cause in self.causes.items():
            if name in fitted.values:
                continue
            best, start = max((self._promise(fitted, cause, values) for values in cause.tried), key=lambda one: one[0])
            if best > self.settings.least_promise:
                promises.append((best, name, start))
        promises.sort(key=lambda one: -one[0])
        return [(name, start) for _, name, start in promises]

    def _promise(self, fitted: FittedSet, cause: SupposedCause, values: np.ndarray) -> tuple[float, np.ndarray]:
        """Return the nats that a cause promises, and where to begin: at `values`, or scaled along them."""
        there = self._evaluate(fitted.values | {cause.name: values}, fitted.linear)
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

    def fit(self, start: Values, best_nats: float = -math.inf) -> FittedSet:
        """Return a set at its likeliest parameters, by Fisher's scoring from where it begins.

        It ends early where another set's `best_nats` are out of reach.
        """
        causes = [self.causes[name] for name in start]
        values = np.concatenate([np.empty(0), *start.values()])
        linear = self._linearise(start)
        here = self._evaluate(start, linear)
        rough = [one.is_rough for one in causes for _ in one.step]
        for index in np.flatnonzero(rough):
            values, here = self._located(start, values, int(index), here, linear)
        if not len(values):
            return FittedSet(start, linear, here, self._nats(here, causes, np.zeros((0, 0))))
        low, high, step = (np.concatenate([getattr(one, each) for one in causes]) for each in ("low", "high", "step"))
        for number in range(self.rounds):
            slope, information = self._slope(start, values, here, linear, high, step)
            step = np.clip(0.5 / np.sqrt(np.diagonal(information) + 1e-12), 0.05 * step, step)
            change = np.linalg.solve(information + np.diag(12.0 / (high - low) ** 2), slope)
            hoped = self._nats(here, causes, information) + self.hope * float(slope @ change)
            if number and hoped < best_nats - 2 * self.hopeless_nats:
                return FittedSet(self._named(start, values), linear, here, hoped)
            best = None
            for share in (1.0, 0.4, 0.1):
                moved = np.clip(values + share * change, low, high)
                there = self._evaluate(self._named(start, moved), linear)
                if there.nats.sum() > here.nats.sum():
                    best = moved, there
                    break
            gained = 0.0 if best is None else float(best[1].nats.sum() - here.nats.sum())
            if best is not None:
                values, here = best
            if gained < 0.05:
                break
            if number == 0:
                linear = self._linearise(self._named(start, values))
                here = self._evaluate(self._named(start, values), linear)
        final = self._named(start, values)
        linear = self._linearise(final)
        here = self._evaluate(final, linear)
        _, information = self._slope(start, values, here, linear, high, step)
        return FittedSet(final, linear, here, self._nats(here, causes, information))

    def _located(
        self, start: Values, values: np.ndarray, index: int, here: Evaluation, linear: Linearised
    ) -> tuple[np.ndarray, Evaluation]:
        """Return parameters (P,) of which one was moved to where it is likeliest, by ever smaller steps."""
        causes = [self.causes[name] for name in start]
        low, high, step = (np.concatenate([getattr(one, each) for one in causes]) for each in ("low", "high", "step"))
        for size in step[index] * 0.4 ** np.arange(-2, 5):
            for sign in (1.0, -1.0):
                while True:
                    moved = values.copy()
                    moved[index] = np.clip(values[index] + sign * size, low[index], high[index])
                    there = self._evaluate(self._named(start, moved), linear)
                    if there.nats.sum() <= here.nats.sum():
                        break
                    values, here = moved, there
        return values, here

    def _nats(self, here: Evaluation, causes: Sequence[SupposedCause], information: np.ndarray) -> float:
        """Return the log of a set's posterior probability, by Laplace's method over uniform priors."""
        offered = len(self.causes)
        nats = float(here.nats.sum()) + prior_nats([one.name for one in causes], offered, self.settings.prior)
        if not causes:
            return nats
        width = np.concatenate([one.high - one.low for one in causes])
        _, log_size = np.linalg.slogdet(information * np.outer(width, width) + 12.0 * np.eye(len(width)))
        return nats + 0.5 * (len(width) * math.log(2 * math.pi) - float(log_size))

    def _slope(
        self,
        start: Values,
        values: np.ndarray,
        here: Evaluation,
        linear: Linearised,
        high: np.ndarray,
        step: np.ndarray,
    ) -> tuple[np.ndarray, np.ndarray]:
        """Return how the log-likelihood changes with each parameter (P,), and Fisher's information (P, P).

        The log-likelihood bends by as much as the information says over the steps by which parameters are changed.
        That of a chance of commands to be lost, which moves no expectation, is the sum of squares over the runs.
        """
        slopes, responses, log_sizes, signed_steps = [], [], [], []
        for index, own in enumerate(step):
            moved = values.copy()
            signed = own if values[index] + own <= high[index] else -own
            moved[index] += signed
            signed_steps.append(signed)
            there = self._evaluate(self._named(start, moved), linear)
            slopes.append((there.nats - here.nats) / signed)
            responses.append((there.surprise - here.surprise) / signed)
            log_sizes.append((there.log_size - here.log_size).ravel() / signed)
        response, log_size, slope = np.stack(responses), np.stack(log_sizes), np.stack(slopes)
        information = response @ response.T + log_size @ log_size.T / 3
        names = [name for name, own in start.items() for _ in own]
        for index, name in enumerate(names):
            if name == "command_loss":
                information[index] = information[:, index] = 0.0
                information[index, index] = float(slope[index] @ slope[index])
        return slope.sum(axis=1) + 0.5 * np.array(signed_steps) * np.diagonal(information), information

    def _named(self, start: Values, values: np.ndarray) -> Values:
        edges = np.cumsum([len(own) for own in start.values()])[:-1]
        return dict(zip(start, np.split(values, edges), strict=True))

    def _effects(self, values: Values) -> list[Effect]:
        session, causes = self.likelihood.driven.session, self.causes
        return [
            effect
            for name, own in values.items()
            for effect in causes[name].effects(own, session.robot, len(session.vehicles))
        ]

    def _linearise(self, values: Values) -> Linearised:
        return self.likelihood.linearise(self._effects(values))

    def _evaluate(self, values: Values, linear: Linearised) -> Evaluation:
        noise = float(values["noise_change"][0]) if "noise_change" in values else 1.0
        return self.likelihood.evaluate(self._effects(values), self.likelihood.gains(linear, noise))

    def _of_no_catalogue(self, outside: Sequence[Effect]) -> float:
        likelihood = self.likelihood
        here = likelihood.evaluate(outside, likelihood.gains(likelihood.linearise(outside)))
        return float(here.nats.sum()) + prior_nats(("outside",), len(self.causes), self.settings.prior)


def oracle_causes(truth: Truth) -> dict[str, dict[str, float]]:
    """Return what the oracle names in a session whose equations it knows."""
    measured, twin = truth.measured, truth.twin
    likelihood = TrueLikelihood.of(measured.footage, measured.recording)
    likelihood = likelihood.with_tails_of(TrueLikelihood.of(twin.footage, twin.recording))
    outside = measured.footage.session.effects if truth.case.kind == "outside" else ()
    return Oracle(likelihood).named(outside)
