"""How well a probabilistic model's stated spread is that of what was measured, and its calibration."""

import math
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from scipy.optimize import minimize_scalar
from scipy.special import logsumexp, ndtr

from swarmtwin.dynamics.mean_variance import MeanVarianceEnsemble
from swarmtwin.dynamics.predictor import NetworkDynamics
from swarmtwin.geometry import wrap_angle
from swarmtwin.learning.situation import Situation
from swarmtwin.robot import DISPLACEMENT_COLUMNS
from swarmtwin.transitions import Transitions


class Mixture(NamedTuple):
    """For each of N transitions a mixture of M normal distributions, components independent within each.

    Attributes:
        residual: (M, N, 3) measured displacements less the means: mm, mm, rad.
        variance: (M, N, 3).
    """

    residual: np.ndarray
    variance: np.ndarray

    @classmethod
    def of(cls, dynamics: NetworkDynamics, transitions: Transitions) -> "Mixture":
        """Ask a probabilistic model for measured situations."""
        situation = Situation.from_transitions(transitions, dynamics.inputs)
        mean, variance = (values.cpu().numpy() for values in dynamics.moments(situation))
        residual = transitions.displacement - mean
        residual[..., 2] = wrap_angle(residual[..., 2])
        return cls(residual, variance)

    def log_density(self) -> np.ndarray:
        """Return (N,) the log of the density at what was measured, in nats, per mm² rad."""
        terms = -0.5 * (self.residual**2 / self.variance + np.log(2 * math.pi * self.variance))
        density: np.ndarray = logsumexp(terms.sum(axis=-1), axis=0) - math.log(len(terms))
        return density

    def cumulative(self) -> np.ndarray:
        """Return (N, 3) the probability, by component, that less is measured: uniform from 0 to 1 if calibrated."""
        below: np.ndarray = ndtr(self.residual / np.sqrt(self.variance)).mean(axis=0)
        return below

    def with_factor(self, factor: np.ndarray | float) -> "Mixture":
        """Return it with standard deviations (3,) times as large."""
        return Mixture(self.residual, self.variance * factor**2)

    def component(self, number: int) -> "Mixture":
        """Return one of the three components alone."""
        return Mixture(*(part[..., number : number + 1] for part in self))


class SpreadFigure(NamedTuple):
    """How well a stated spread is the measured one.

    Attributes:
        coverage: by component and stated share (0.5, 0.9, 0.95), the share of transitions in the central interval.
        nll_nats: mean negative log-likelihood of a measured displacement, in nats (of mm, mm and rad).
    """

    coverage: dict[str, dict[float, float]]
    nll_nats: float

    @classmethod
    def of(cls, mixture: Mixture, shares: Sequence[float] = (0.5, 0.9, 0.95)) -> "SpreadFigure":
        """Compare what was measured with the distributions stated for it."""
        off_centre = 2 * np.abs(mixture.cumulative() - 0.5)
        coverage = {
            name: {share: float((off_centre[:, number] <= share).mean()) for share in shares}
            for number, name in enumerate(DISPLACEMENT_COLUMNS)
        }
        return cls(coverage, float(-mixture.log_density().mean()))

    def covered(self, share: float) -> float:
        """Return the coverage of intervals of a stated share, the mean over the components."""
        return float(np.mean([by_share[share] for by_share in self.coverage.values()]))

    def named(self) -> dict[str, float]:
        """Return the figures by name: coverage in percent, over all components, and the negative log-likelihood."""
        shares = next(iter(self.coverage.values()))
        covered = {f"coverage_of_{100 * share:g}_percent": 100 * self.covered(share) for share in shares}
        return {**covered, "nll_nats": self.nll_nats}


def calibrate_spread(dynamics: NetworkDynamics, unseen: Transitions, largest_factor: float = 10.0) -> None:
    """Scale a probabilistic model's standard deviations, by component, so that `unseen` transitions are most likely.

    The means stay, and with them how far members differ: what is scaled is the noise from period to period.

    Args:
        dynamics: whose network is a `MeanVarianceEnsemble`.
        unseen: transitions that it was not fitted to.
        largest_factor: by which it may be wrong, either way.
    """
    assert isinstance(dynamics.network, MeanVarianceEnsemble)
    dynamics.network.spread_factor.fill_(1.0)
    mixture = Mixture.of(dynamics, unseen)
    bound = math.log(largest_factor)
    for number in range(3):
        alone = mixture.component(number)
        found = minimize_scalar(
            lambda log, alone=alone: -alone.with_factor(math.exp(log)).log_density().mean(),
            bounds=(-bound, bound),
            method="bounded",
        )
        dynamics.network.spread_factor[number] = math.exp(found.x)
