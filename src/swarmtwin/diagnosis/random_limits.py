"""Step 4. How many lost commands, and how much more noise, a session would have shown: causes that move no mean."""

import math
from typing import NamedTuple

import numpy as np
from scipy import optimize, stats

from swarmtwin.diagnosis.explanation import Explanation
from swarmtwin.diagnosis.likelihood import MechanismClass, SessionLikelihood
from swarmtwin.diagnosis.motion_noise_change import expected_noise_log, noise_change_probability, usual_noise_spread
from swarmtwin.diagnosis.noise import log_density
from swarmtwin.diagnosis.result import DetectionLimit
from swarmtwin.simulation.mechanism import Mechanism, mechanism_class


def noise_limit(explained: Explanation, power: float) -> DetectionLimit:
    """Return by what factor the motion's noise would have had to grow to be named; `power` is a normal quantile."""
    model, kind = explained.model, mechanism_class("noise_change")
    error = model.motion_noise_log()[1]
    mechanisms = explained.best.mechanisms
    usual, expected = usual_noise_spread(model, mechanisms), expected_noise_log(model, mechanisms)
    settings = model.settings
    parameter = kind.parameters["factor"]
    largest = math.log(parameter.high)

    def lacking(log: float) -> float:
        return noise_change_probability(log, error, usual, settings) - settings.search.named_from

    beyond = optimize.brentq(lacking, 1e-6, largest) + power * error if lacking(largest) > 0 else math.inf
    log = max(expected + beyond, 0.0)
    value = math.exp(log) if log < largest else None
    share = (value - 1) / parameter.size if value else 1.0
    return DetectionLimit(cause="noise_change", parameter="factor", value=value, unit="", share_of_range=share)


def loss_limit(
    kind: MechanismClass,
    model: SessionLikelihood,
    needed: float,
    power: float,
    share_searched: float,
    unfitted: SessionLikelihood | None = None,
) -> DetectionLimit:
    """Return what share of the commands would have had to be lost to be named.

    Args:
        kind: a mechanism that loses commands, its parameter their share.
        model: of the session.
        needed: nats of log odds against a cause, before the price of its parameter.
        power: normal quantile of the probability to be named.
        share_searched: of the session's transitions in which causes are searched.
        unfitted: the held-out runs, which must be measurably more likely.
    """
    ((name, parameter),) = kind.parameters_of(model.robot, model.session.conditions).items()
    fitted, held_out = _moved_by_loss(kind, model), _moved_by_loss(kind, unfitted) if unfitted else None
    value = None
    for share in np.geomspace(1e-4, parameter.high, 60):
        here = _expected(fitted, float(share), model.noise.degrees_of_freedom).times(share_searched)
        price = math.log(parameter.size) + math.log(max(here.information, 1e-9) / (2 * math.pi)) / 2
        seen = here.nats - power * math.sqrt(here.variance) > needed + price
        if seen and held_out:
            there = _expected(held_out, float(share), model.noise.degrees_of_freedom)
            seen = there.nats > (power + stats.norm.ppf(0.975)) * math.sqrt(there.variance)
        if seen:
            value = float(share)
            break
    return DetectionLimit(
        cause=kind.model_fields["name"].default,
        parameter=name,
        value=value,
        unit=parameter.unit,
        share_of_range=value / parameter.size if value else 1.0,
    )


class _Expected(NamedTuple):
    """What lost commands bring to the log-likelihood: mean, variance, and curvature in their share."""

    nats: float
    variance: float
    information: float

    def times(self, factor: float) -> "_Expected":
        """Return it of a session so many times as long."""
        return _Expected(*(factor * value for value in self))


class _MovedByLoss(NamedTuple):
    """How far a loss moves transitions (M,), in units of the noise, and how many each of them stands for."""

    length: np.ndarray
    weight: float


def _moved_by_loss(kind: MechanismClass, model: SessionLikelihood, most: int = 1000) -> _MovedByLoss:
    """Return how far it moves transitions if the command before goes on, of at most so many."""
    lossy: list[Mechanism] = [kind.at(dict.fromkeys(kind.parameters_of(model.robot, model.session.conditions), 0.1))]
    outcomes = model.predictor.outcomes(lossy)
    change = model.errors_of(outcomes[2]) - model.errors_of(outcomes[0])
    length = np.linalg.norm(model.filter(change[..., None])[..., 0], axis=1)
    chosen = length[:: -(-len(length) // most)]
    return _MovedByLoss(chosen, len(length) / len(chosen))


def _expected(moved: _MovedByLoss, share: float, freedom: float | None, points: int = 15) -> _Expected:
    """Return what a share of lost commands is expected to bring, by quadrature over the noise along each move."""
    nodes, weights = np.polynomial.hermite_e.hermegauss(points)
    weights = weights / weights.sum()
    length = moved.length[:, None]
    nats, squares, information = (np.zeros(len(length)) for _ in range(3))
    for chance, shift in ((1 - share, 0.0), (share, length)):
        seen = nodes + shift
        arrived, lost = _density(seen, freedom), _density(seen - length, freedom)
        mixed = np.logaddexp(math.log1p(-share) + arrived, math.log(share) + lost)
        slope = np.exp(lost - mixed) - np.exp(arrived - mixed)
        nats += chance * ((mixed - arrived) @ weights)
        squares += chance * ((mixed - arrived) ** 2 @ weights)
        information += chance * (slope**2 @ weights)
    variance = np.maximum(squares - nats**2, 0.0)
    return _Expected(*(moved.weight * float(values.sum()) for values in (nats, variance, information)))


def _density(along: np.ndarray, freedom: float | None) -> np.ndarray:
    """Return log densities of whitened errors that lie along one direction, (M, K)."""
    errors = np.zeros((*along.shape, 3))
    errors[..., 0] = along
    density: np.ndarray = log_density(errors, freedom)
    return density
