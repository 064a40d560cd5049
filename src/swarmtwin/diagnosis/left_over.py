"""Step 3, its end: what causes leave of a session, and how much of that an uncertain simulation may leave."""

import math
from dataclasses import replace
from typing import NamedTuple

import numpy as np
from scipy import special

from swarmtwin.diagnosis.beyond_reference import nats_beyond_reference
from swarmtwin.diagnosis.error_history import nats_by_history
from swarmtwin.diagnosis.estimated_set import EstimatedSet
from swarmtwin.diagnosis.gain_by_chance import beyond_uncertainty, nats_by_chance
from swarmtwin.diagnosis.likelihood import FittedMechanisms, SessionLikelihood, arriving
from swarmtwin.diagnosis.noise import log_density
from swarmtwin.diagnosis.random_effects import member_disagreement
from swarmtwin.diagnosis.reference_errors import ReferenceErrors
from swarmtwin.diagnosis.varying_causes import nats_by_variation


class LeftOver(NamedTuple):
    """What a set of causes leaves over, in nats on runs that a regression has not seen.

    Attributes:
        by_situation: that flexible regressions on the situation gain.
        by_history: that one on the errors before gains, beyond what it may gain on the reference.
        most_uncertainty: that the first one may gain by the simulation's own uncertainty at most, where that was asked.
        most_lasting_uncertainty: that the second one may gain so at most.
        most_by_chance: that the causes may gain by it at most: each as much as the likeliest one alone, and all
            together no more than the first regression.
        beyond_reference: by which the session tells more of the causes than the reference, driven alike.
        by_variation: that regressions on how what the causes do varies gain.
        certain: the causes that show more than an uncertain simulation imitates of them, where that was asked.
    """

    by_situation: float
    by_history: float
    most_uncertainty: float = 0.0
    most_lasting_uncertainty: float = 0.0
    most_by_chance: float = 0.0
    beyond_reference: float = math.inf
    by_variation: float = 0.0
    certain: frozenset[str] = frozenset()

    @property
    def nats(self) -> float:
        """What can still be explained."""
        return max(self.by_situation, self.by_history)


def left_over(model: SessionLikelihood, best: EstimatedSet, gained: float, reference: ReferenceErrors) -> LeftOver:
    """Look at what a set of causes, which gains so many nats over none, leaves of a session's fitted runs."""
    fitted, settings = best.fitted, model.settings.verdict
    errors = model.errors_left(best.mechanisms) - fitted.effect_errors
    by_situation, by_history = _nats_by_situation(model, fitted, errors), nats_by_history(model, fitted)
    by_variation = nats_by_variation(model, fitted)
    disagreement = member_disagreement(model, arriving(best.mechanisms)) if best.names else model.disagreement
    could_be = float((model.filter(disagreement) ** 2).sum()) / 2  # nats, were all of it predicted
    beyond_usual = by_history
    if by_history > settings.nameless_nats:  # less decides nothing, and what is usual costs a pass of the reference
        beyond_usual -= _usual_nats_by_history(model, reference)
    if max(by_situation, beyond_usual) <= settings.alarm_nats and (not best.names or gained > could_be):
        return LeftOver(by_situation, beyond_usual, by_variation=by_variation)
    drawn = nats_of_uncertainty(model, fitted, disagreement, settings.uncertainty_draws)
    expected, spread = drawn.mean(axis=0), drawn.std(axis=0)
    most = np.maximum(expected + settings.uncertainty_spreads * spread, 0.0)
    by_chance, beyond, certain = float(most[0]), math.inf, frozenset[str]()
    if 0 < gained <= by_chance:  # a catalogue follows less of the simulation's error than a regression does
        single = nats_by_chance(model, fitted.residual, settings.chance_draws)
        most_single = float(single.mean() + settings.uncertainty_spreads * single.std())
        by_chance = min(by_chance, len(best.names) * most_single)
        certain = beyond_uncertainty(model, best.mechanisms)
        if arriving(best.mechanisms) and (own := reference.granted):
            beyond = nats_beyond_reference(model, own, best.mechanisms)
    return LeftOver(
        by_situation,
        beyond_usual,
        float(most[0]),
        float(most[1]),
        by_chance,
        beyond,
        by_variation,
        certain,
    )


def _usual_nats_by_history(model: SessionLikelihood, reference: ReferenceErrors) -> float:
    """Return the nats that errors before may gain in a session as they do on the reference, at most."""
    usual, ratio = reference.nats_by_history * len(model.session), len(model.session) / reference.transitions
    # half a squared normal variate, nearly: its standard error is the root of twice as many
    return usual + model.settings.verdict.uncertainty_spreads * math.sqrt(2 * usual * (1 + ratio))


def _nats_by_situation(model: SessionLikelihood, fitted: FittedMechanisms, errors: np.ndarray) -> float:
    """Return the nats by which errors (N, 3) are likelier, given what regressions on the situation say of them.

    One looks at all of the situation, the others each at a part of it alone; which of them is right is not known.
    """
    freedom, residual = model.noise.degrees_of_freedom, model.filter(errors[..., None])[..., 0]
    predicted = model.filter(np.stack(model.regressions.predicted(errors), axis=-1))
    before, *after = (
        float(log_density(left / fitted.scale, freedom).sum())
        for left in (residual, *(residual - one for one in np.moveaxis(predicted, -1, 0)))
    )
    return float(special.logsumexp(after)) - math.log(len(after)) - before


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
