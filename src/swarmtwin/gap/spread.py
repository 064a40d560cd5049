"""Whether only the spread of the motion changed; what the camera adds shows in how neighbouring residuals disagree."""

from dataclasses import dataclass

import numpy as np
import torch

from swarmtwin.dynamics.twist import twist_of
from swarmtwin.gap.base import AnyBase
from swarmtwin.gap.dependence import Examined, tested_parts
from swarmtwin.gap.fitting import Fit, Problem
from swarmtwin.gap.likeness import likeness
from swarmtwin.gap.motion import Base, likeliest_displacement
from swarmtwin.gap.noise import residual_of
from swarmtwin.geometry import rotate

DRAWS = 1000
AXES = (0, 2)
LARGEST_Z = 6.0
SURE_ERRORS = 4.5
UNSURE_ERRORS = 3.0
LARGEST_NONE = 0.25
LEAST_CHANGE = 0.04
LARGE_CAMERA_SHARE = 0.2
LEAST_CHANGE_BESIDE = 0.35
LEAST_CHANGE_OF_OTHERS = 0.45
LARGEST_DISAGREEMENT = 0.6
LARGEST_SQUARE = 12.0
LEAST_UNEVEN = 0.01


@dataclass(frozen=True)
class Spread:
    """How much the random part of the motion is larger than the reference's.

    Attributes:
        factor: on its standard deviation.
        low: end of the 95 % interval.
        high: end of the 95 % interval.
        errors: how many standard errors the log of the factor is from none.
        agrees: whether motion ahead and turning say the same.
        is_even: whether it is the same whatever the command, the place and the time.
        least: the smallest change that counts: beside other causes, whose mechanisms are never exact, a larger one.
        camera_grew: whether the camera's own noise is much larger than the reference's.
    """

    factor: float
    low: float
    high: float
    errors: float
    agrees: bool
    is_even: bool
    least: float
    camera_grew: bool

    @property
    def is_none(self) -> bool:
        """Whether the motion is as random as ever, whatever became of the camera's noise."""
        if self.camera_grew and abs(self.factor - 1) < self.least:
            return True
        return abs(self.errors) < UNSURE_ERRORS and abs(np.log(self.factor)) < LARGEST_NONE

    @property
    def is_news(self) -> bool:
        """Whether it is sure, large enough to matter, and the same ahead and turning."""
        return self.agrees and self.is_even and abs(self.errors) > SURE_ERRORS and abs(self.factor - 1) > self.least


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
    weight_of_known = likeness(problem.session, known.session)
    there = _motion_squares(known, None, known.base, weight_of_known)
    drawn = _ratios(here, rng, DRAWS)[:, :-1] / _ratios(there, rng, DRAWS)[:, :-1]
    value = (here.sum(axis=0)[:-1] / here.sum(axis=0)[-1]) / (there.sum(axis=0)[:-1] / there.sum(axis=0)[-1])
    if (value <= 0).any():
        return Spread(1.0, 1.0, 1.0, 0.0, False, False, LEAST_CHANGE, False)
    logs = 0.5 * np.log(np.maximum(drawn, 1e-3))
    single = 0.5 * np.log(value)
    weight = 1 / np.maximum(logs.var(axis=0), 1e-9)
    weight /= weight.sum()
    log, errors = float(single @ weight), logs @ weight
    spread = float(errors.std())
    apart = abs(float(single[0] - single[1]))
    agrees = apart < max(LARGEST_DISAGREEMENT * abs(log), 3 * float((logs[:, 0] - logs[:, 1]).std()))
    grew = _camera_grew(problem, fit, known)
    least = _least_change(problem, fit, grew)
    low, high = np.exp(log + np.quantile(errors - errors.mean(), [0.025, 0.975]))
    factor = float(np.exp(log))
    even = _is_even(problem, fit, known, factor, weight_of_known, rng)
    return Spread(factor, float(low), float(high), log / max(spread, 1e-9), agrees, even, least, grew)


def _camera_grew(problem: Problem, fit: Fit, known: Problem) -> bool:
    """Say whether the camera's own noise is much larger than the reference's."""
    usual = (known.whitener.spread.numpy() ** 2).mean(axis=0)
    more = _camera_variance(problem, fit) - _camera_variance(known)
    return bool((more > LARGE_CAMERA_SHARE * usual)[list(AXES)].any())


def _least_change(problem: Problem, fit: Fit, camera_grew: bool) -> float:
    """Return the smallest change of the factor that counts: a larger one beside anything else that may look like it."""
    least = LEAST_CHANGE_OF_OTHERS if problem.units.count else LEAST_CHANGE
    return max(least, LEAST_CHANGE_BESIDE) if fit.mechanisms or camera_grew else least


def _is_even(
    problem: Problem, fit: Fit, known: Problem, factor: float, weight: np.ndarray, rng: np.random.Generator
) -> bool:
    """Say whether squares, over what they would be with `factor`, depend on nothing that the reference's do not."""
    camera = _camera_variance(known)
    here = _squares_over_expected(problem, fit, factor, camera, np.ones(len(problem.session)))
    there = _squares_over_expected(known, None, 1.0, camera, weight)
    return not any(test.found for test in tested_parts(here, there, rng) if test.explained > LEAST_UNEVEN)


def _camera_variance(problem: Problem, fit: Fit | None = None) -> np.ndarray:
    """Return (3,) the part of residuals' variance that is the camera's: neighbours disagree by it."""
    session = problem.session
    way = twist_of(likeliest_displacement(problem.base, fit.mechanisms if fit else (), session.drive))
    raw = residual_of(session, way)
    follows = session.follows >= 0
    earlier = raw[np.maximum(session.follows, 0)]
    turned = torch.cat([rotate(earlier[:, :2], -session.turned), earlier[:, 2:]], dim=-1)
    shared = -(raw * turned).numpy()[follows].mean(axis=0)
    return np.clip(2 * shared, 0.0, None)


def _squares_over_expected(
    problem: Problem, fit: Fit | None, factor: float, camera: np.ndarray, weight: np.ndarray
) -> Examined:
    session = problem.session
    way = twist_of(likeliest_displacement(problem.base, fit.mechanisms if fit else (), session.drive))
    variance = problem.noise.whitener(way, session).spread.numpy() ** 2
    expected = variance + (factor**2 - 1) * np.maximum(variance - camera, 0.1 * variance)
    squares = np.minimum(residual_of(session, way).numpy() ** 2 / expected, LARGEST_SQUARE)
    level = squares.mean(axis=0)
    deviation = (squares - level) / squares.std(axis=0)
    deviation[:, 1] = 0.0
    return Examined(session, deviation, np.zeros_like(deviation), np.empty((0, *deviation.shape)), weight)


def _motion_squares(problem: Problem, fit: Fit | None, base: Base, weight: np.ndarray | None = None) -> np.ndarray:
    """Return (R, 3): sums over each run of the motion's squares ahead and turning, and of the weights (N,)."""
    session = problem.session
    mechanisms = fit.mechanisms if fit else ()
    way = twist_of(likeliest_displacement(base, mechanisms, session.drive))
    spread = problem.noise.whitener(way, session).spread
    scaled = (residual_of(session, way) / spread).clamp(-LARGEST_Z, LARGEST_Z)
    follows = session.follows >= 0
    earlier = scaled[np.maximum(session.follows, 0)]
    turned = torch.cat([rotate(earlier[:, :2], -session.turned), earlier[:, 2:]], dim=-1)
    squares = (scaled**2 + earlier**2) / 2 + 2 * scaled * turned
    counted = follows * (1.0 if weight is None else weight)
    return session.by_run(np.column_stack([squares[:, AXES].numpy() * counted[:, None], counted]))


def _ratios(by_run: np.ndarray, rng: np.random.Generator, draws: int) -> np.ndarray:
    weights = rng.multinomial(len(by_run), np.full(len(by_run), 1 / len(by_run)), draws)
    sums = weights @ by_run
    ratios: np.ndarray = sums / np.maximum(sums[:, -1:], 1)
    return ratios
