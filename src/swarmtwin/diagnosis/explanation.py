"""Step 3, its end: what the causes of a session explain of what can be explained at all, and what is said of it."""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property

import numpy as np
from scipy import stats

from swarmtwin.diagnosis.cause_search import CausePosterior, is_of_exact_form
from swarmtwin.diagnosis.estimated_set import EstimatedSet
from swarmtwin.diagnosis.estimation import estimate, with_further_uncertainty
from swarmtwin.diagnosis.left_over import LeftOver, left_over
from swarmtwin.diagnosis.likelihood import SessionLikelihood, loses_commands
from swarmtwin.diagnosis.motion_noise_change import MotionNoiseChange, motion_noise_change
from swarmtwin.diagnosis.reference_errors import ReferenceErrors, outliers
from swarmtwin.diagnosis.result import ENDS, Verdict
from swarmtwin.simulation.mechanism import Mechanism, Parameter


@dataclass(frozen=True)
class Explanation:
    """What the causes of a session explain, and what they leave.

    Attributes:
        model: of the fitted runs, its noise that of what the causes leave.
        posterior: over sets of causes.
        best: the causes of the most probable set that can be told from doing nothing, estimated anew in that model.
        gained: nats that they gain over no cause.
        left: what they leave over, in nats.
        motion_noise: how random the motion is beside these causes.
        reference: what its own errors show.
    """

    model: SessionLikelihood
    posterior: CausePosterior
    best: EstimatedSet
    gained: float
    left: LeftOver
    motion_noise: MotionNoiseChange
    reference: ReferenceErrors = field(default_factory=ReferenceErrors)

    @property
    def share(self) -> float:
        """Share of what can be explained at all that the causes explain."""
        return float(np.clip(self.gained / max(self.gained + self.left.nats, 1e-9), 0.0, 1.0))

    @property
    def alarm(self) -> float:
        """Nats left over from which on something is wrong that nobody has named."""
        settings = self.model.settings.verdict
        return settings.alarm_nats + settings.alarm_nats_a_transition * len(self.model.session)

    @property
    def is_something_left(self) -> bool:
        """Whether more is left over than chance, another form of the same causes, and an uncertain simulation leave."""
        left = self.left
        return self._is_too_much(
            left.by_situation - left.most_uncertainty, left.by_history - left.most_lasting_uncertainty, self.alarm
        )

    @property
    def is_uncertain(self) -> bool:
        """Whether the causes gain no more than they may where nothing but the simulation is uncertain, at most.

        Unless each of them shows more than that imitates of it. Or whether they gain hardly more than the reference
        itself shows of them, where that was asked.
        """
        may_be_imitated = not self.left.certain.issuperset(self.best.names)
        return self._hardly_gains or (self.gained <= self.left.most_by_chance and may_be_imitated)

    @property
    def _hardly_gains(self) -> bool:
        return self.left.beyond_reference <= self.model.settings.verdict.alarm_nats

    @property
    def may_be_chance(self) -> bool:
        """Whether the causes gain so little that no alarm would be raised, were it left over.

        Not where one of them is read off the clock, or the motion is more random.
        """
        on_the_clock = any(self.model.read_off_clock(type(one)) for one in self.best.mechanisms)
        gains_little = 0 < self.gained <= self.alarm + self.left.most_uncertainty
        return gains_little and not on_the_clock and not self.names_motion_noise

    @property
    def _may_be_something_left(self) -> bool:
        """Whether so much is left that something else may be wrong as well, were the simulation certain."""
        return self._is_too_much(self.left.by_situation, self.left.by_history, self.alarm)

    @property
    def _may_be_another_cause(self) -> bool:
        """Likewise, where less is enough: it takes little to say that these are not the causes, or not all of them.

        So does that what they do varies, as that of the true ones does not.
        """
        nats = self.model.settings.verdict.nameless_nats
        by_situation = max(self.left.by_situation, self.left.by_variation)
        return self._is_too_much(by_situation, self.left.by_history, nats)

    @cached_property
    def at_an_end(self) -> frozenset[str]:
        """The causes of which a parameter cannot be told from an end of its range where they do something, and is near.

        Beyond it the cause may fit better, or another one that this one stands for.
        """
        nearest = self.model.settings.verdict.nearest_end
        return frozenset(
            name
            for name, parameter, value, reach in self._estimates()
            if any(abs(value - end) <= min(reach, nearest * parameter.size) for end in parameter.doubted)
        )

    @cached_property
    def telling(self) -> tuple[str, ...]:
        """The causes but for those that cannot be told from doing nothing, which may be a unit's own.

        That is asked where a cause acts to both sides of doing nothing: its estimate is as good as normal there.
        """
        may_do_nothing: dict[str, bool] = {}
        for name, parameter, value, reach in self._estimates():
            if parameter.null_value is not None and parameter.low < parameter.null_value < parameter.high:
                holds_null = abs(value - parameter.null_value) <= reach
                may_do_nothing[name] = may_do_nothing.get(name, True) and holds_null
        return tuple(name for name in self.best.names if not may_do_nothing.get(name, False))

    def _estimates(self) -> Iterator[tuple[str, Parameter, float, float]]:
        """Yield cause, parameter and value of the best causes, and how far their intervals reach to each side."""
        deviations = stats.norm.ppf(ENDS[1])
        reaches = deviations * np.sqrt(np.diag(self.best.covariance))
        parameters = self.model.parameters([type(one) for one in self.best.mechanisms])
        for (number, _, parameter), value, reach in zip(parameters, self.best.values, reaches, strict=True):
            yield self.best.names[number], parameter, float(value), float(reach)

    def _is_too_much(self, by_situation: float, by_history: float, nats: float) -> bool:
        settings, gained = self.model.settings.verdict, max(self.gained, 0.0)
        lasts = by_history > nats + settings.most_lasting * gained
        return lasts or by_situation > nats + settings.most_left * gained

    @property
    def sure(self) -> tuple[str, ...]:
        """The causes that lead, where they or one of their rivals are sure to be there."""
        settings, posterior = self.model.settings.search, self.posterior
        found = []
        for name in self.best.names:
            rivals = posterior.rivals(name, settings.rival_from)
            is_leading = posterior.probability(name) >= settings.reported_from
            if is_leading and posterior.probability(name, *rivals) >= settings.named_from:
                found.append(name)
        return tuple(found)

    @cached_property
    def leaves_outliers(self) -> bool:
        """Whether the causes leave more single large errors than the reference has, beyond chance.

        What moves no mean is seen by the spread of errors alone, and any mishap now and then looks like it.
        """
        return self._leaves_more_outliers_by(self.model.settings.dependence.least_tails_change)

    @property
    def _leaves_more_than_losses(self) -> bool:
        """Whether commands that are said to be lost leave such errors: what is taken for a loss is another mishap then.

        On wheels it is known exactly what a lost command leads to, and few of many such mishaps look like that: the
        others are left.
        """
        lossy = [one for one in self.best.mechanisms if loses_commands([type(one)])]
        settings = self.model.settings.dependence
        usual = settings.least_tails_change
        if all(is_of_exact_form(self.model, type(one)) for one in lossy):
            usual = min(
                [usual, *(settings.least_tails_change_a_loss * (1 - one.arrival_probability()) for one in lossy)]
            )
        return bool(lossy) and self._leaves_more_outliers_by(usual)

    def _leaves_more_outliers_by(self, share: float) -> bool:
        large = outliers(self.model, self.best.fitted)
        chance = stats.binom.sf(large.sum() - 1, len(large), self.reference.outliers + share)
        return bool(chance < self.model.settings.dependence.false_discovery_rate)

    @property
    def names(self) -> tuple[str, ...]:
        """The causes that are named: those that are sure.

        None where much is left, be it the simulation's uncertainty, where outliers are left beside commands that are
        said to be lost, where that uncertainty may gain as much, where a value may lie at the end of what it can be, or
        where it takes many causes: a name would be made up. One that may as well do nothing is not among the causes any
        more.
        """
        takes_many = len(self.posterior.best.names) > self.model.settings.search.most_causes
        if self._may_be_another_cause or self.is_uncertain or self.at_an_end or takes_many:
            return ()
        if self._leaves_more_than_losses:
            return ()
        return self.sure

    @property
    def names_motion_noise(self) -> bool:
        """Whether the motion's randomness is a cause."""
        is_in_doubt = self._may_be_something_left or (self.best.names and self._may_be_another_cause)
        return self._is_more_random and not is_in_doubt and not self.leaves_outliers

    @property
    def _is_more_random(self) -> bool:
        return self.motion_noise.probability >= self.model.settings.search.named_from

    @property
    def verdict(self) -> Verdict:
        """What to say."""
        if self.is_something_left:
            return "unexplained"
        if self.names or self.names_motion_noise:
            return "explained"
        is_probable = self.posterior.of_any >= self.model.settings.search.named_from
        is_there = not self.is_uncertain or (self.left.certain and not self._hardly_gains)
        is_seen = self.best.names and is_there and is_probable
        is_seen = is_seen or (self._is_more_random and self.leaves_outliers)
        return "unexplained" if is_seen else "no_gap"

    @cached_property
    def mechanisms(self) -> tuple[Mechanism, ...]:
        """The mechanisms that the simulation is extended by."""
        return tuple(one for one in self.best.mechanisms if one.name in self.names)


def explanation(
    model: SessionLikelihood, posterior: CausePosterior, reference: ReferenceErrors | None = None
) -> Explanation:
    """Look at what the best causes leave of a session.

    Causes that may as well do nothing are left out, and the others estimated without them: the values of two that make
    up for each other mean nothing one by one. So is one that is not sure and ends where its values do, if the others
    explain the session without it.

    Args:
        model: of the fitted runs.
        posterior: over sets of causes.
        reference: what its own errors show likewise; None: nothing.
    """
    reference = reference or ReferenceErrors()
    found = _by_telling(posterior.best.mechanisms, model, posterior, reference)
    if found.at_an_end and found.sure and found.at_an_end.isdisjoint(found.sure):
        kept = [mechanism for mechanism in found.best.mechanisms if mechanism.name not in found.at_an_end]
        without = _by_telling(kept, model, posterior, reference)
        return without if without.names else found
    return found


def _by_telling(
    mechanisms: Sequence[Mechanism], model: SessionLikelihood, posterior: CausePosterior, reference: ReferenceErrors
) -> Explanation:
    """Look at what causes leave, without those that may as well do nothing beside the others."""
    found = _explained_by(mechanisms, model, posterior, reference)
    while len(found.telling) < len(found.best.names):
        kept = [mechanism for mechanism in found.best.mechanisms if mechanism.name in found.telling]
        likelier = posterior.is_likelier_than_nothing([mechanism.name for mechanism in kept])
        found = _explained_by(kept if likelier else (), model, posterior, reference)
    return found


def left_by_nothing(model: SessionLikelihood, posterior: CausePosterior, reference: ReferenceErrors) -> Explanation:
    """Look at what is left of a session without any cause, given as in `explanation`."""
    return _explained_by((), model, posterior, reference)


def _explained_by(
    mechanisms: Sequence[Mechanism], model: SessionLikelihood, posterior: CausePosterior, reference: ReferenceErrors
) -> Explanation:
    refined = model.explained_by(mechanisms)
    best = with_further_uncertainty(refined, estimate(refined, mechanisms, polish=True, final=True))
    gained = best.fitted.total - refined.evaluate([]).total
    noise = motion_noise_change(refined, best.mechanisms, lambda: reference.motion_noise_log)
    left = left_over(refined, best, gained, reference)
    return Explanation(refined, posterior, beyond_usual_loss(refined, best, reference), gained, left, noise, reference)


def beyond_usual_loss(model: SessionLikelihood, best: EstimatedSet, reference: ReferenceErrors) -> EstimatedSet:
    """Return a set that loses the commands that the session loses beyond those the reference seems to lose as well.

    Times that are not exact, or strokes of a fin that are not known, look like that now and then; how often in the
    session is known to within as much.
    """
    kinds = best.fitted.kinds
    if not loses_commands(kinds):
        return best
    shift, moved = np.zeros(len(best.values)), np.zeros((len(best.values), 1))
    for index, (number, _, parameter) in enumerate(model.parameters(kinds)):
        if loses_commands([kinds[number]]):
            seems, also = best.values[index], min(reference.loss, best.values[index])
            shift[index] = max((seems - also) / (1 - also), parameter.low) - seems
            moved[index] = also
    beyond = best.beyond(shift, moved)
    return replace(beyond, fitted=replace(best.fitted, mechanisms=tuple(model.assembled(kinds, beyond.values))))
