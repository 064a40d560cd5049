"""Step 3, its end: what causes explain of what can be explained at all, and whether the motion is more random."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import NamedTuple

import numpy as np
from scipy import special, stats

from swarmtwin.diagnosis.cause_search import CausePosterior
from swarmtwin.diagnosis.error_history import nats_by_history
from swarmtwin.diagnosis.estimation import EstimatedSet, estimate
from swarmtwin.diagnosis.likelihood import SessionLikelihood, arriving
from swarmtwin.diagnosis.noise import log_density
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


@dataclass(frozen=True)
class Explanation:
    """What the causes of a session explain, and what they leave.

    Attributes:
        model: of the fitted runs, its noise that of what the causes leave.
        posterior: over sets of causes.
        best: the most probable set, estimated anew in that model.
        gained: nats that it gains over no cause.
        left: nats that a flexible regression on the situation still gains on runs that it has not seen.
        lasting: nats that one on the errors before gains likewise, beyond what it gains on the reference.
        motion_noise: how random the motion is beside these causes.
    """

    model: SessionLikelihood
    posterior: CausePosterior
    best: EstimatedSet
    gained: float
    left: float
    lasting: float
    motion_noise: MotionNoiseChange

    @property
    def share(self) -> float:
        """Share of what can be explained at all that the causes explain."""
        return float(np.clip(self.gained / max(self.gained + max(self.left, self.lasting), 1e-9), 0.0, 1.0))

    @property
    def alarm(self) -> float:
        """Nats left over from which on something is wrong that nobody has named."""
        settings = self.model.settings.verdict
        return settings.alarm_nats + settings.alarm_nats_a_transition * len(self.model.session)

    @property
    def is_something_left(self) -> bool:
        """Whether more is left over than chance, and than another form of the same causes would leave."""
        settings, gained = self.model.settings.verdict, max(self.gained, 0.0)
        lasts = self.lasting > self.alarm + settings.most_lasting * gained
        return lasts or self.left > self.alarm + settings.most_left * gained

    @property
    def names(self) -> tuple[str, ...]:
        """The causes that are named: one that leads, where it or one of its rivals is sure to be there.

        None where much is left: a name would be made up.
        """
        if self.is_something_left:
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
        return not self.is_something_left and self.motion_noise.probability >= self.model.settings.search.named_from

    @property
    def verdict(self) -> Verdict:
        """What to say."""
        if self.is_something_left:
            return "unexplained"
        if self.names or self.names_motion_noise:
            return "explained"
        return "unexplained" if self.best.names else "no_gap"

    @cached_property
    def mechanisms(self) -> tuple[Mechanism, ...]:
        """The mechanisms that the simulation is extended by."""
        return tuple(one for one in self.best.mechanisms if one.name in self.names)


class Usual(NamedTuple):
    """What is asked of the reference where it matters, measured like the session.

    Attributes:
        noise_log: the log of the factor on the noise of the reference's own motion.
        history_nats: nats a transition that its own errors gain by those before them.
    """

    noise_log: Callable[[], float] = float
    history_nats: Callable[[], float] = float


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
    nothing = refined.evaluate([])
    return Explanation(
        refined,
        posterior,
        best,
        best.fitted.total - nothing.total,
        _nats_left(refined, best),
        _nats_lasting(refined, best, usual.history_nats),
        _motion_noise(refined, best.mechanisms, usual.noise_log),
    )


def _nats_left(model: SessionLikelihood, best: EstimatedSet) -> float:
    """Return the nats that a flexible regression gains on what a set of causes leaves, on runs that it has not seen."""
    errors = model.errors_left(best.mechanisms) - best.fitted.effect_errors
    spread = model.noise.spread(model.motion)
    expected = model.filter(model.flexible.predicted(errors, spread, model.weight)[..., None])[..., 0]
    residual, freedom = best.fitted.residual, model.noise.degrees_of_freedom
    scale = best.fitted.scale
    before, after = (log_density(one / scale, freedom) for one in (residual, residual - expected))
    return float((after - before).sum())


def _nats_lasting(model: SessionLikelihood, best: EstimatedSet, usual_nats: Callable[[], float]) -> float:
    """Return the nats that errors gain by those before them, beyond the reference's; it is asked where they alarm."""
    nats = nats_by_history(model, best.fitted)
    return nats - usual_nats() * len(model.session) if nats > model.settings.verdict.alarm_nats else nats


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
    return float(np.linalg.norm([usual, grown, _share_of_motion(model, mechanisms)]))


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
