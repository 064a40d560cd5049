"""Whether only the spread of the motion changed; what the camera adds shows in how neighbouring residuals disagree."""

from dataclasses import dataclass

import numpy as np
import torch

from swarmtwin.dynamics.twist import twist_of
from swarmtwin.gap.base import AnyBase
from swarmtwin.gap.fitting import Fit, Problem
from swarmtwin.gap.motion import Base, likeliest_displacement
from swarmtwin.gap.noise import residual_of
from swarmtwin.geometry import rotate

DRAWS = 1000
AXES = (0, 2)
LARGEST_Z = 6.0
SURE_ERRORS = 4.5
LEAST_CHANGE = 0.04
LEAST_CHANGE_BESIDE = 0.35
LARGEST_DISAGREEMENT = 0.25


@dataclass(frozen=True)
class Spread:
    """How much the random part of the motion is larger than the reference's.

    Attributes:
        factor: on its standard deviation.
        low: end of the 95 % interval.
        high: end of the 95 % interval.
        errors: how many standard errors the log of the factor is from none.
        agrees: whether motion ahead and turning say the same.
        least: the smallest change that counts: beside other causes, whose mechanisms are never exact, a larger one.
    """

    factor: float
    low: float
    high: float
    errors: float
    agrees: bool
    least: float

    @property
    def is_news(self) -> bool:
        """Whether it is sure, large enough to matter, and the same ahead and turning."""
        return self.agrees and abs(self.errors) > SURE_ERRORS and abs(self.factor - 1) > self.least


def compare_spread(problem: Problem, fit: Fit, known: Problem, base: AnyBase, rng: np.random.Generator) -> Spread:
    """Compare the random part of the motion with the reference's, like with like: single members of the simulation.

    With white motion noise and a camera that errs each time anew, a residual's variance is that of the motion and twice
    the camera's, and its covariance with the next one is minus the camera's: their sum is the motion's alone.
    """
    members: list[int | None] = list(range(base.members)) or [None]
    sums = []
    for member in members:
        base.member = member
        try:
            sums.append(_motion_squares(problem, fit, base))
        finally:
            base.member = None
    here = np.mean(sums, axis=0)
    there = _motion_squares(known, None, known.base)
    drawn = _ratios(here, rng, DRAWS)[:, :-1] / _ratios(there, rng, DRAWS)[:, :-1]
    value = (here.sum(axis=0)[:-1] / here.sum(axis=0)[-1]) / (there.sum(axis=0)[:-1] / there.sum(axis=0)[-1])
    if (value <= 0).any():
        return Spread(1.0, 1.0, 1.0, 0.0, False, LEAST_CHANGE)
    logs = 0.5 * np.log(np.maximum(drawn, 1e-3))
    single = 0.5 * np.log(value)
    weight = 1 / np.maximum(logs.var(axis=0), 1e-9)
    weight /= weight.sum()
    log, errors = float(single @ weight), logs @ weight
    spread = float(errors.std())
    apart = abs(float(single[0] - single[1]))
    agrees = apart < max(LARGEST_DISAGREEMENT * abs(log), 3 * float((logs[:, 0] - logs[:, 1]).std()))
    least = LEAST_CHANGE_BESIDE if fit.mechanisms else LEAST_CHANGE
    low, high = np.exp(log + np.quantile(errors - errors.mean(), [0.025, 0.975]))
    return Spread(float(np.exp(log)), float(low), float(high), log / max(spread, 1e-9), agrees, least)


def _motion_squares(problem: Problem, fit: Fit | None, base: Base) -> np.ndarray:
    """Return (R, 3): sums over each run of the motion's squares ahead and turning, and how many went into them."""
    session = problem.session
    mechanisms = fit.mechanisms if fit else ()
    way = twist_of(likeliest_displacement(base, mechanisms, session.drive))
    spread = problem.noise.whitener(way, session).spread
    scaled = (residual_of(session, way) / spread).clamp(-LARGEST_Z, LARGEST_Z)
    follows = session.follows >= 0
    earlier = scaled[np.maximum(session.follows, 0)]
    turned = torch.cat([rotate(earlier[:, :2], -session.turned), earlier[:, 2:]], dim=-1)
    squares = (scaled**2 + earlier**2) / 2 + 2 * scaled * turned
    kept = squares[:, AXES].numpy() * follows[:, None]
    return session.by_run(np.column_stack([kept, follows.astype(float)]))


def _ratios(by_run: np.ndarray, rng: np.random.Generator, draws: int) -> np.ndarray:
    weights = rng.multinomial(len(by_run), np.full(len(by_run), 1 / len(by_run)), draws)
    sums = weights @ by_run
    ratios: np.ndarray = sums / np.maximum(sums[:, -1:], 1)
    return ratios
