"""A set of causes at its likeliest parameters, by the true likelihood, and how probable that makes the set."""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from swarmtwin.diagnosis.settings import SearchSettings
from swarmtwin.standin.effect import Effect
from swarmtwin.studies.hidden_effects.baselines.oracle_causes import SupposedCause, prior_nats, supposed_causes
from swarmtwin.studies.hidden_effects.baselines.oracle_filter import Linearised, TrueLikelihood
from swarmtwin.studies.hidden_effects.baselines.oracle_follower import Evaluation

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
class SetFits:
    """Fits of sets of causes to one session; a set's parameters are integrated out by Laplace's method.

    Attributes:
        likelihood: of the session.
        settings: of the diagnosis' own search: the prior of a cause.
        hopeless_nats: half as far behind another set a fit is given up.
        rounds: of Fisher's scoring.
        hope: for more nats, over what a quadratic likelihood would gain twice, before a fit is given up.
    """

    likelihood: TrueLikelihood
    settings: SearchSettings
    hopeless_nats: float
    rounds: int = 8
    hope: float = 2.0

    @cached_property
    def causes(self) -> dict[str, SupposedCause]:
        """All that may hide."""
        session = self.likelihood.driven.session
        return supposed_causes(session.robot, len(session.vehicles), session.conditions.character.delay_s)

    def fit(self, start: Values, best_nats: float = -math.inf) -> FittedSet:
        """Return a set at its likeliest parameters, by Fisher's scoring from where it begins.

        It ends early where another set's `best_nats` are out of reach.
        """
        causes = [self.causes[name] for name in start]
        values = np.concatenate([np.empty(0), *start.values()])
        linear = self._linearise(start)
        here = self.evaluate(start, linear)
        if not len(values):
            return FittedSet(start, linear, here, self._nats(here, causes, np.zeros((0, 0))))
        low, high, step = (np.concatenate([getattr(one, each) for one in causes]) for each in ("low", "high", "step"))
        is_rough = np.array([one.is_rough for one in causes for _ in one.step])
        smallest = np.where(is_rough, 1.0, 0.05) * step
        for number in range(self.rounds):
            for index in np.flatnonzero(is_rough):
                values, here = self._located(start, values, int(index), here, linear)
            slope, information = self._slope(start, values, here, linear, high, step)
            step = np.clip(0.5 / np.sqrt(np.diagonal(information) + 1e-12), smallest, step)
            slope[is_rough], information[is_rough[:, None] != is_rough] = 0.0, 0.0
            change = np.linalg.solve(information + np.diag(12.0 / (high - low) ** 2), slope)
            hoped = self._nats(here, causes, information) + self.hope * float(slope @ change)
            if number and hoped < best_nats - 2 * self.hopeless_nats:
                return FittedSet(self._named(start, values), linear, here, hoped)
            best = None
            for share in (1.0, 0.4, 0.1):
                moved = np.clip(values + share * change, low, high)
                there = self.evaluate(self._named(start, moved), linear)
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
                here = self.evaluate(self._named(start, values), linear)
        final = self._named(start, values)
        linear = self._linearise(final)
        here = self.evaluate(final, linear)
        _, information = self._slope(start, values, here, linear, high, step)
        return FittedSet(final, linear, here, self._nats(here, causes, information))

    def _located(
        self, start: Values, values: np.ndarray, index: int, here: Evaluation, linear: Linearised
    ) -> tuple[np.ndarray, Evaluation]:
        """Return parameters (P,) of which one was moved to where it is likeliest, by ever smaller steps."""
        causes = [self.causes[name] for name in start]
        low, high, step = (np.concatenate([getattr(one, each) for one in causes]) for each in ("low", "high", "step"))
        for size in step[index] * 0.6 ** np.arange(-4, 7):
            for sign in (1.0, -1.0):
                while True:
                    moved = values.copy()
                    moved[index] = np.clip(values[index] + sign * size, low[index], high[index])
                    there = self.evaluate(self._named(start, moved), linear)
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
            there = self.evaluate(self._named(start, moved), linear)
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

    def evaluate(self, values: Values, linear: Linearised) -> Evaluation:
        """Return the session under a set of causes, chance being as it was linearised."""
        noise = float(values["noise_change"][0]) if "noise_change" in values else 1.0
        return self.likelihood.evaluate(self._effects(values), self.likelihood.gains(linear, noise))

    def of_no_catalogue(self, outside: Sequence[Effect]) -> float:
        """Return the log-probability of effects beside the catalogue, as they are, with the prior of one cause."""
        likelihood = self.likelihood
        here = likelihood.evaluate(outside, likelihood.gains(likelihood.linearise(outside)))
        return float(here.nats.sum()) + prior_nats(("outside",), len(self.causes), self.settings.prior)
