"""Step 3, its end: what causes explain of what can be explained at all, and whether the motion is more random."""

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import NamedTuple

import numpy as np
from scipy import special, stats

from swarmtwin.diagnosis.cause_search import CausePosterior
from swarmtwin.diagnosis.error_history import nats_by_history
from swarmtwin.diagnosis.estimation import EstimatedSet, estimate
from swarmtwin.diagnosis.likelihood import FittedMechanisms, SessionLikelihood, arriving
from swarmtwin.diagnosis.noise import log_density
from swarmtwin.diagnosis.random_effects import member_disagreement
from swarmtwin.diagnosis.result import Verdict
from swarmtwin.diagnosis.settings import DiagnosisSettings
from swarmtwin.simulation.mechanism import Mechanism


class MotionNoiseChange(NamedTuple):
    """How much more random the motion is than the reference's.

    Attributes:
        factor: on its standard deviation.
        low: of the 95 % interval.
        high: of it, what sessions of one robot differ by included.
        probability: that this is a cause, and no difference that two sessions of one robot have.
    """

    factor: float
    low: float
    high: float
    probability: float


class LeftOver(NamedTuple):
    """What a set of causes leaves over, in nats on runs that a regression has not seen.

    Attributes:
        by_situation: that a flexible regression on the situation gains.
        by_history: that one on the errors before gains, beyond what it may gain on the reference.
        uncertainty: that the first one is expected to gain by the simulation's own uncertainty, where that was asked.
        most_uncertainty: that it may gain so at most.
        most_lasting_uncertainty: that the second one may gain so at most.
    """

    by_situation: float
    by_history: float
    uncertainty: float = 0.0
    most_uncertainty: float = 0.0
    most_lasting_uncertainty: float = 0.0

    @property
    def nats(self) -> float:
        """What can still be explained."""
        return max(self.by_situation, self.by_history)


@dataclass(frozen=True)
class Explanation:
    """What the causes of a session explain, and what they leave.

    Attributes:
        model: of the fitted runs, its noise that of what the causes leave.
        posterior: over sets of causes.
        best: the most probable set, estimated anew in that model.
        gained: nats that it gains over no cause.
        left: what they leave over, in nats.
        motion_noise: how random the motion is beside these causes.
    """

    model: SessionLikelihood
    posterior: CausePosterior
    best: EstimatedSet
    gained: float
    left: LeftOver
    motion_noise: MotionNoiseChange

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
            left.by_situation - left.most_uncertainty, left.by_history - left.most_lasting_uncertainty
        )

    @property
    def is_uncertain(self) -> bool:
        """Whether the causes gain no more than the simulation's own uncertainty would."""
        return self.gained <= self.left.uncertainty

    @property
    def _may_be_something_left(self) -> bool:
        """Likewise, were the simulation certain."""
        return self._is_too_much(self.left.by_situation, self.left.by_history)

    @property
    def _is_at_an_end(self) -> bool:
        """Whether a parameter is at an end of its range where it does something: beyond it may fit better."""
        nearest = self.model.settings.verdict.nearest_end
        kinds = [type(one) for one in self.best.mechanisms]
        for value, (_, _, parameter) in zip(self.best.values, self.model.parameters(kinds), strict=True):
            ends = (end for end in (parameter.low, parameter.high) if parameter.null_value not in (None, end))
            if any(abs(value - end) < nearest * parameter.size for end in ends):
                return True
        return False

    def _is_too_much(self, by_situation: float, by_history: float) -> bool:
        settings, gained = self.model.settings.verdict, max(self.gained, 0.0)
        lasts = by_history > self.alarm + settings.most_lasting * gained
        return lasts or by_situation > self.alarm + settings.most_left * gained

    @property
    def names(self) -> tuple[str, ...]:
        """The causes that are named: one that leads, where it or one of its rivals is sure to be there.

        None where much is left, be it the simulation's uncertainty, where that would gain as much, or where a value
        runs to the end of what it can be: a name would be made up.
        """
        if self._may_be_something_left or self.is_uncertain or self._is_at_an_end:
            return ()
        settings, posterior = self.model.settings.search, self.posterior
        named = []
        for name in self.best.names:
            rivals = posterior.rivals(name, settings.rival_from)
            is_leading = posterior.probability(name) >= settings.reported_from
            if is_leading and posterior.probability(name, *rivals) >= settings.named_from:
                named.append(name)
        return tuple(named)

    @property
    def names_motion_noise(self) -> bool:
        """Whether the motion's randomness is a cause."""
        return (
            not self._may_be_something_left and self.motion_noise.probability >= self.model.settings.search.named_from
        )

    @property
    def verdict(self) -> Verdict:
        """What to say."""
        if self.is_something_left:
            return "unexplained"
        if self.names or self.names_motion_noise:
            return "explained"
        return "unexplained" if self.best.names and not self.is_uncertain else "no_gap"

    @cached_property
    def mechanisms(self) -> tuple[Mechanism, ...]:
        """The mechanisms that the simulation is extended by."""
        return tuple(one for one in self.best.mechanisms if one.name in self.names)


class Usual(NamedTuple):
    """What is asked of the reference where it matters, measured like the session.

    Attributes:
        noise_log: the log of the factor on the noise of the reference's own motion.
        history_nats: nats a transition that its own errors gain by those before them.
        transitions: how many these nats are known from.
    """

    noise_log: Callable[[], float] = float
    history_nats: Callable[[], float] = float
    transitions: Callable[[], int] = lambda: 1


def explanation(model: SessionLikelihood, posterior: CausePosterior, usual: Usual | None = None) -> Explanation:
    """Look at what the best causes leave of a session.

    Args:
        model: of the fitted runs.
        posterior: over sets of causes.
        usual: what the reference's own errors show likewise; None: nothing.
    """
    usual = usual or Usual()
    refined = model.explained_by(posterior.best.mechanisms)
    best = estimate(refined, posterior.best.mechanisms, polish=True, smooth=True)
    gained = best.fitted.total - refined.evaluate([]).total
    noise = _motion_noise(refined, best.mechanisms, usual.noise_log)
    return Explanation(refined, posterior, best, gained, _left_over(refined, best, gained, usual), noise)


def _left_over(model: SessionLikelihood, best: EstimatedSet, gained: float, usual: Usual) -> LeftOver:
    fitted, settings = best.fitted, model.settings.verdict
    errors = model.errors_left(best.mechanisms) - fitted.effect_errors
    by_situation, by_history = _nats_by_situation(model, fitted, errors), nats_by_history(model, fitted)
    disagreement = member_disagreement(model, arriving(best.mechanisms)) if best.names else model.disagreement
    could_be = float((model.filter(disagreement) ** 2).sum()) / 2  # nats, were all of it predicted
    if max(by_situation, by_history) <= settings.alarm_nats and (not best.names or gained > could_be):
        return LeftOver(by_situation, by_history)
    drawn = nats_of_uncertainty(model, fitted, disagreement, settings.uncertainty_draws)
    expected, spread = drawn.mean(axis=0), drawn.std(axis=0)
    most = np.maximum(expected + settings.uncertainty_spreads * spread, 0.0)
    usual_nats, ratio = usual.history_nats() * len(model.session), len(model.session) / usual.transitions()
    # half a squared normal variate, nearly: its standard error is the root of twice as many
    usual_nats += settings.uncertainty_spreads * math.sqrt(2 * usual_nats * (1 + ratio))
    return LeftOver(by_situation, by_history - usual_nats, max(float(expected[0]), 0.0), float(most[0]), float(most[1]))


def _nats_by_situation(model: SessionLikelihood, fitted: FittedMechanisms, errors: np.ndarray) -> float:
    """Return the nats by which errors (N, 3) are likelier, given what a regression on the situation says of them."""
    spread = model.noise.spread(model.motion)
    predicted = model.flexible.predicted(errors, spread, model.weight)
    residual, expected = (model.filter(one[..., None])[..., 0] for one in (errors, predicted))
    freedom = model.noise.degrees_of_freedom
    before, after = (log_density(one / fitted.scale, freedom) for one in (residual, residual - expected))
    return float((after - before).sum())


def nats_of_uncertainty(
    model: SessionLikelihood, fitted: FittedMechanisms, disagreement: np.ndarray, draws: int
) -> np.ndarray:
    """Return (draws, 2) the nats that both regressions gain where nothing but the simulation is uncertain.

    It was learned from so many transitions, and what it therefore gets wrong is the same each time that a vehicle comes
    by: a regression on a long session, or on one of other commands than the reference's, finds it. As members that have
    seen different runs disagree (jackknife), errors are drawn, and added to noise in which nothing depends on anything:
    the session's own, in another order.

    Args:
        model: of N transitions.
        fitted: mechanisms, and the errors that they leave.
        disagreement: (N, 3, M) of the simulation's members, with these mechanisms.
        draws: of the simulation's error and of the order.
    """
    directions = model.filter(disagreement)
    members = directions.shape[-1]
    found = np.zeros((draws, 2))
    if not members:
        return found
    rng = np.random.default_rng(0)
    for number in range(draws):
        residual = rng.permutation(fitted.residual) + directions @ rng.normal(size=members)
        by_situation = _nats_by_situation(model, fitted, model.filter.inverse(residual))
        found[number] = by_situation, nats_by_history(model, replace(fitted, residual=residual))
    return found


def _motion_noise(
    model: SessionLikelihood, mechanisms: Sequence[Mechanism], usual_log: Callable[[], float]
) -> MotionNoiseChange:
    """Compare the motion's noise with the reference's, and where that may have changed with its own motion's."""
    log, error = model.motion_noise_log()
    usual = usual_noise_spread(model, mechanisms)

    def change(log: float) -> MotionNoiseChange:
        probability = noise_change_probability(log, error, usual, model.settings)
        low, high = np.exp(log + np.array([-1.96, 1.96]) * np.hypot(error, usual))
        return MotionNoiseChange(float(np.exp(log)), float(low), float(high), probability)

    found = change(log)
    return change(log - usual_log()) if found.probability >= 0.5 else found


def usual_noise_spread(model: SessionLikelihood, mechanisms: Sequence[Mechanism]) -> float:
    """Return the standard deviation of the log of the noise's factor between sessions in which it is no cause."""
    settings = model.settings.motion_noise
    usual = settings.usual_spread_beside if mechanisms or model.strange else settings.usual_spread
    if model.has_momentum:
        usual = max(usual, settings.usual_spread_with_momentum)
    grown = settings.growth_spread * model.reference_noise.log_from_usual(model.motion)
    wrong = float(
        (model.filter(model.disagreement) ** 2).sum(axis=-1).mean()
    )  # of the simulation, in its noise's units
    return float(np.linalg.norm([usual, grown, math.log1p(wrong) / 2, _share_of_motion(model, mechanisms)]))


def _share_of_motion(model: SessionLikelihood, mechanisms: Sequence[Mechanism]) -> float:
    """Return what share of way and turn mechanisms change, root mean square: by as much they may change the noise."""
    change = (model.predictor.twist(arriving(mechanisms)) - model.simulated).numpy()
    changed, moved = ((twist[:, [0, 2]] ** 2).mean(axis=0) for twist in (change, model.motion))
    return float(np.sqrt(changed / np.maximum(moved, 1e-12)).max())


def noise_change_probability(log: float, error: float, usual: float, settings: DiagnosisSettings) -> float:
    """Return the probability that a factor on the noise is a cause; normal priors on its log, a narrow and a wide.

    Args:
        log: of the factor, as it was measured.
        error: of that, standard deviation.
        usual: standard deviation where it is no cause.
        settings: of the diagnosis.
    """
    odds = settings.search.prior / (1 - settings.search.prior)
    wide_log, narrow_log = (
        stats.norm.logpdf(log, 0.0, np.hypot(error, spread)) for spread in (settings.motion_noise.changed_spread, usual)
    )
    return float(special.expit(wide_log - narrow_log + np.log(odds)))
