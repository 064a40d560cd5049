"""Step 4. The smallest effect of each cause that a session would have shown: what "no gap" means."""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from scipy import stats

from swarmtwin.diagnosis.cause_search import is_of_exact_form, prior_log_odds, share_beside, too_little_nats
from swarmtwin.diagnosis.explanation import Explanation
from swarmtwin.diagnosis.gains import confirmed_from
from swarmtwin.diagnosis.likelihood import MechanismClass, SessionLikelihood, arriving, loses_commands
from swarmtwin.diagnosis.random_limits import loss_limit, noise_limit
from swarmtwin.diagnosis.result import DetectionLimit
from swarmtwin.diagnosis.screening import Candidate, candidates
from swarmtwin.diagnosis.sized_causes import Rivals, SizedCause, Surroundings
from swarmtwin.simulation.mechanism import Mechanism, offered


@dataclass(frozen=True)
class FoundLimit:
    """A limit, with the mechanisms that it is about.

    Attributes:
        limit: as it is reported.
        mechanism: the cause at its limit, as large as it may be where no value would be named; None where it moves no
            mean.
        rival: what a smaller one would be taken for, with the values that come nearest; None where for nothing.
    """

    limit: DetectionLimit
    mechanism: Mechanism | None = None
    rival: Mechanism | None = None


def detection_limits(
    explained: Explanation,
    unfitted: SessionLikelihood | None = None,
    kinds: Mapping[str, MechanismClass] | None = None,
) -> tuple[FoundLimit, ...]:
    """Return for each cause the smallest size that would have been named with a probability of 90 %, by its name.

    Three things must come true; each follows from the likelihood of what was measured. The nats that an effect brings,
    normal about half its squared length in units of the noise, all that is no gap integrated out, exceed the prior
    odds, those of being named, and the price of its parameters. The session speaks for it and not for another cause
    that imitates it as well as it can. And errors fall measurably on the held-out runs. Lost commands and noise, which
    move no mean, are counted by what they bring in the same likelihood; jitter, which is read off the clock, has no
    limit.

    A cause that was found is looked at beside the others of its set alone, any other one beside all that were found.

    Args:
        explained: the session.
        unfitted: the held-out runs, where they are to confirm what is named.
        kinds: the mechanisms that were offered, by name; None: the whole catalogue.
    """
    model, best = explained.model, explained.best
    kinds = model.shown_of(kinds or offered(model.robot, model.session.conditions))
    part, rivals = _screened(model, best.mechanisms, kinds)
    beside_all = _Limits(explained, best.mechanisms, unfitted, part)
    found = beside_all.of_moving(rivals, rivals)
    for name in best.names:
        others = [one for one in best.mechanisms if one.name != name]
        own = candidates(part, part.evaluate(others), {name: kinds[name]})
        found += _Limits(explained, others, unfitted, part).of_moving(own, rivals)
    found += [FoundLimit(beside_all.of_loss(kind)) for kind in kinds.values() if loses_commands([kind])]
    found += [FoundLimit(noise_limit(explained, beside_all.power))] if "noise_change" in kinds else []
    return tuple(sorted(found, key=lambda one: one.limit.cause))


def _screened(
    model: SessionLikelihood, mechanisms: Sequence[Mechanism], kinds: Mapping[str, MechanismClass]
) -> tuple[SessionLikelihood, list[Candidate]]:
    """Return the part of a session in which causes are looked at, and these; all of it where it alone shows one."""
    part = model.thinned(model.settings.search.most_screened)
    found = candidates(part, part.evaluate(mechanisms), kinds)
    if part is model:
        return part, found
    shown = {one.name for one in found if np.any(one.columns)}
    unseen = {name: kind for name, kind in kinds.items() if name not in shown and not loses_commands([kind])}
    whole = model.evaluate(mechanisms)
    if any(np.any(one.columns) for one in candidates(model, whole, unseen)):
        return model, candidates(model, whole, kinds)
    return part, found


class _Limits:
    """Looks for limits beside mechanisms that are there already.

    Where a cause shows best, and what it may be taken for, a part of the session tells; how much of it there must be,
    all of it.
    """

    def __init__(
        self,
        explained: Explanation,
        beside: Sequence[Mechanism],
        unfitted: SessionLikelihood | None,
        part: SessionLikelihood,
        power: float = 0.9,
    ) -> None:
        self.model, self.power = explained.model, float(stats.norm.ppf(power))
        self.around = Surroundings(self.model, beside)
        self.around_in_part = self.around if part is self.model else Surroundings(part, beside)
        self._times_as_long = len(self.model.session) / len(part.session)
        settings = self.model.settings.search
        searched = len(explained.posterior.nothing.fitted.residual)
        self.share_searched = searched / len(self.model.session)
        self._sure = prior_log_odds(settings) + math.log(settings.named_from / (1 - settings.named_from))
        self.too_little = too_little_nats(settings, searched)
        self._beside = [type(one) for one in beside]
        posterior = explained.posterior
        exact = [one.name for one in posterior.best.mechanisms if is_of_exact_form(self.model, type(one))]
        self._gained = posterior.best.evidence - (posterior.of_names(exact) or posterior.nothing).evidence
        self.unfitted = unfitted
        if unfitted:
            self._error = unfitted.errors(arriving(explained.best.mechanisms)) + unfitted.correction
            self._without = unfitted.errors(self.around.arriving)

    def of_moving(self, found: Sequence[Candidate], rivals: Sequence[Candidate]) -> list[FoundLimit]:
        """Return the limits of causes, each at the point of its grid at which it shows best, beside their rivals."""
        clearest: dict[str, tuple[float, SizedCause]] = {}
        for one in found:
            if one.off and np.any(one.columns):
                cause = SizedCause.of(one, self.model)
                size = self._proportional_size(one)
                share = size / cause.parameter.size
                if one.name not in clearest or share < clearest[one.name][0] / clearest[one.name][1].parameter.size:
                    clearest[one.name] = size, cause
        known = Rivals(self.around_in_part, rivals)
        return [self._limit(name, cause, size, known) for name, (size, cause) in clearest.items()]

    def _needed(self, kind: MechanismClass) -> float:
        """Return the nats from which on a mechanism would be named, beside others that are there."""
        settings, beside = self.model.settings.search, self._beside
        with_it, without = (share_beside(settings, self.model, kinds) for kinds in ([*beside, kind], beside))
        return self._sure + (with_it - without) * max(self._gained, 0.0)

    def of_loss(self, kind: MechanismClass) -> DetectionLimit:
        """Return the limit of a mechanism that loses commands."""
        return loss_limit(
            kind, self.model, self._needed(kind) + self.too_little, self.power, self.share_searched, self.unfitted
        )

    def _proportional_size(self, one: Candidate) -> float:
        """Return the size from which on a cause would be seen if its effect grew in proportion."""
        first = one.columns[:, :1]
        length = math.sqrt(max(self._times_as_long * float(self.around_in_part.gram(first)[0, 0]), 1e-12))
        needed = self._needed(one.form) + self.too_little
        return (math.sqrt(2 * needed) + self.power) * abs(next(iter(one.off.values()))) / length

    def _limit(self, name: str, cause: SizedCause, size: float, rivals: Rivals, rounds: int = 5) -> FoundLimit:
        """Let a cause grow, or shrink, until it would just be named: by the secant of logarithms."""
        size, slope = min(size, cause.largest), -1.0
        known: list[tuple[float, float]] = []
        rival: Mechanism | None = None
        for number in range(rounds):
            if number < 2:  # it hardly changes with the size
                price = self.around.price(cause.at(size))
            factor, rival = self._wanted(cause.at(size), price, rivals)
            if size == cause.largest and factor > 1:
                return FoundLimit(_reported(name, cause, None), cause.at(size), rival)
            known.append((math.log(size), math.log(min(factor, 1e3))))
            if abs(known[-1][1]) < 0.05:
                break
            if len(known) > 1 and known[-1][0] != known[-2][0]:
                slope = (known[-1][1] - known[-2][1]) / (known[-1][0] - known[-2][0])
            size = min(math.exp(known[-1][0] - known[-1][1] / min(max(slope, -4.0), -0.5)), cause.largest)
        return FoundLimit(_reported(name, cause, size, rival), cause.at(size), rival)

    def _wanted(self, mechanism: Mechanism, price: float, rivals: Rivals) -> tuple[float, Mechanism | None]:
        """Return how many times as much a cause must show to be named, and what it is taken for if it shows less."""
        change = self.around.change(mechanism)
        length = math.sqrt(max(float(self.around.gram(change[:, None])[0, 0]), 1e-12))
        whole = math.sqrt(self.share_searched)
        needed = self._needed(type(mechanism)) + price + self.too_little * self._share_of_evidence(change, length)
        seen = (math.sqrt(2 * needed) + self.power) / (whole * length)
        rival, apart = self._nearest(mechanism, change, rivals)
        told = 2 * self.power / (whole * apart)
        confirmed = 0.0
        if self.unfitted:
            beside = self.around.arriving
            moved = self.unfitted.errors_near([*beside, mechanism], beside) - self._without
            confirmed = confirmed_from(self._error, moved, self.unfitted.session.run)
        return max(seen, told, confirmed), rival if told > max(seen, confirmed) else None

    def _share_of_evidence(self, change: np.ndarray, length: float) -> float:
        """Return what share of a change (3 N,) is evidence, its length known, where other units may differ by it."""
        if not self.model.unknown_vehicles:
            return 1.0
        return min(length**2 / max(float(np.repeat(self.model.weight, 3) @ change**2), 1e-12), 1.0)

    def _nearest(
        self, mechanism: Mechanism, change: np.ndarray, rivals: Rivals, alike: float = 0.7, tried: int = 2
    ) -> tuple[Mechanism | None, float]:
        """Return the cause that comes nearest to what a mechanism changes (3 N,), of the two most alike."""
        nearest, least = None, math.inf
        in_part = change if self.around_in_part is self.around else self.around_in_part.change(mechanism)
        for rival in rivals.alike(in_part, mechanism.name, alike)[:tried]:
            imitation = self.around_in_part.imitation(in_part, rival)
            apart = self.around.apart(change, imitation) if imitation else math.inf
            if apart < least:
                nearest, least = imitation, apart
        return nearest, least


def _reported(cause_name: str, cause: SizedCause, size: float | None, rival: Mechanism | None = None) -> DetectionLimit:
    return DetectionLimit(
        cause=cause_name,
        parameter=cause.name,
        value=None if size is None else cause.value(size),
        unit=cause.parameter.unit,
        share_of_range=1.0 if size is None else float(np.clip(size / cause.parameter.size, 0.0, 1.0)),
        rival=rival.name if rival else None,
    )
