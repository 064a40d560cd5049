"""Step 3. Whether only the motion's spread changed; the camera's part shows in how neighbouring residuals disagree."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from swarmtwin.diagnosis.dependence import StandardisedResidual, situation_tests
from swarmtwin.diagnosis.likelihood import LikelihoodModel
from swarmtwin.diagnosis.settings import MotionNoiseSettings
from swarmtwin.simulation.mechanism import Mechanism


@dataclass(frozen=True)
class MotionNoise:
    """How much more random the motion is than the reference's.

    Attributes:
        factor: on its standard deviation.
        low: end of the 95 % interval.
        high: end of the 95 % interval.
        errors: how many standard errors the log of the factor is from none.
        agrees: whether motion ahead and turning say the same.
        is_even: whether it is the same whatever the command, the place and the time.
        least: the smallest change that counts: beside other causes, whose mechanisms are never exact, a larger one.
        camera_grew: whether the camera's own noise is much larger than the reference's.
        settings: the thresholds.
    """

    factor: float
    low: float
    high: float
    errors: float
    agrees: bool
    is_even: bool
    least: float
    camera_grew: bool
    settings: MotionNoiseSettings

    @property
    def is_none(self) -> bool:
        """Whether the motion is as random as ever, whatever became of the camera's noise."""
        if self.camera_grew and abs(self.factor - 1) < self.least:
            return True
        small = abs(np.log(self.factor)) < self.settings.largest_none
        return abs(self.errors) < self.settings.unsure_errors and bool(small)

    @property
    def is_cause(self) -> bool:
        """Whether it is sure, large enough to matter, and the same ahead and turning."""
        is_sure = abs(self.errors) > self.settings.sure_errors
        return self.agrees and self.is_even and is_sure and abs(self.factor - 1) > self.least


def compare_motion_noise(
    model: LikelihoodModel,
    mechanisms: Sequence[Mechanism],
    reference_model: LikelihoodModel,
    rng: np.random.Generator,
) -> MotionNoise:
    """Compare the random part of the motion with the reference's, like with like: single members of the simulation.

    With white motion noise and a camera that errs each time anew, a residual's variance is that of the motion and twice
    the camera's, and its covariance with the next one is minus the camera's: their sum is the motion's alone.

    Args:
        model: of the session.
        mechanisms: the causes found in it.
        reference_model: of the reference's own transitions.
        rng: for the resamples of runs.
    """
    settings = model.settings.motion_noise
    members: list[int | None] = list(range(model.members)) or [None]
    here = np.mean([_motion_squares(model, mechanisms, member) for member in members], axis=0)
    weight = model.session.covariate_overlap(reference_model.session, model.settings.reference.overlap_neighbours)
    there = _motion_squares(reference_model, weight=weight)
    drawn = _ratios(here, rng, settings.draws)[:, :-1] / _ratios(there, rng, settings.draws)[:, :-1]
    value = (here.sum(axis=0)[:-1] / here.sum(axis=0)[-1]) / (there.sum(axis=0)[:-1] / there.sum(axis=0)[-1])
    if (value <= 0).any():
        return MotionNoise(1.0, 1.0, 1.0, 0.0, False, False, settings.least_change, False, settings)
    logs = 0.5 * np.log(np.maximum(drawn, 1e-3))
    single = 0.5 * np.log(value)
    precision = 1 / np.maximum(logs.var(axis=0), 1e-9)
    precision /= precision.sum()
    log, deviations = float(single @ precision), logs @ precision
    error = float(deviations.std())
    apart, apart_error = abs(float(single[0] - single[1])), float((logs[:, 0] - logs[:, 1]).std())
    agrees = apart < max(settings.largest_disagreement * abs(log), settings.disagreement_errors * apart_error)
    usual = (reference_model.whitener.residual_scale.numpy() ** 2).mean(axis=0)
    camera = _camera_variance(reference_model)
    grew = _camera_variance(model, mechanisms) - camera > settings.large_camera_share * usual
    camera_grew = bool(grew[[0, 2]].any())
    least = settings.least_change_of_others if model.units.count else settings.least_change
    if mechanisms or camera_grew:
        least = max(least, settings.least_change_beside)
    low, high = np.exp(log + np.quantile(deviations - deviations.mean(), [0.025, 0.975]))
    factor = float(np.exp(log))
    squares = _squares_over_expected(model, mechanisms, factor, camera, np.ones(len(model.session)))
    reference_squares = _squares_over_expected(reference_model, (), 1.0, camera, weight)
    tests = situation_tests(squares, reference_squares, model.settings.dependence, rng)
    is_even = not any(test.found for test in tests if test.explained > settings.least_uneven)
    return MotionNoise(
        factor, float(low), float(high), log / max(error, 1e-9), agrees, is_even, least, camera_grew, settings
    )


def _camera_variance(model: LikelihoodModel, mechanisms: Sequence[Mechanism] = ()) -> np.ndarray:
    """Return (3,) the part of residuals' variance that is the camera's: neighbours disagree by it."""
    session = model.session
    raw = session.residual_of(model.likeliest_twist(mechanisms))
    shared = -(raw * session.before(raw)).numpy()[session.follows >= 0].mean(axis=0)
    return np.clip(2 * shared, 0.0, None)


def _squares_over_expected(
    model: LikelihoodModel, mechanisms: Sequence[Mechanism], factor: float, camera: np.ndarray, weight: np.ndarray
) -> StandardisedResidual:
    """Return squares over what they would be with motion noise `factor` times as large, for tests of evenness."""
    session, settings = model.session, model.settings.motion_noise
    twist = model.likeliest_twist(mechanisms)
    variance = model.noise.whitener(twist, session).residual_scale.numpy() ** 2
    motion = np.maximum(variance - camera, settings.least_motion_share * variance)
    expected = variance + (factor**2 - 1) * motion
    squares = np.minimum(session.residual_of(twist).numpy() ** 2 / expected, settings.clip_squared)
    deviation = (squares - squares.mean(axis=0)) / squares.std(axis=0)
    deviation[:, 1] = 0.0
    return StandardisedResidual(session, deviation, np.zeros_like(deviation), np.empty((0, *deviation.shape)), weight)


def _motion_squares(
    model: LikelihoodModel,
    mechanisms: Sequence[Mechanism] = (),
    member: int | None = None,
    weight: np.ndarray | None = None,
) -> np.ndarray:
    """Return (R, 3): sums over each run of the motion's squares ahead and turning, and of the weights (N,).

    To the side, wheels hardly move.
    """
    session, clip_z = model.session, model.settings.motion_noise.clip_z
    twist = model.likeliest_twist(mechanisms, member)
    scale = model.noise.whitener(twist, session).residual_scale
    scaled = (session.residual_of(twist) / scale).clamp(-clip_z, clip_z)
    earlier = scaled[np.maximum(session.follows, 0)]
    squares = (scaled**2 + earlier**2) / 2 + 2 * scaled * session.before(scaled)
    counted = (session.follows >= 0) * (1.0 if weight is None else weight)
    return session.by_run(np.column_stack([squares[:, [0, 2]].numpy() * counted[:, None], counted]))


def _ratios(by_run: np.ndarray, rng: np.random.Generator, draws: int) -> np.ndarray:
    """Return sums over resampled runs over those of the weights, (draws, columns)."""
    weights = rng.multinomial(len(by_run), np.full(len(by_run), 1 / len(by_run)), draws)
    sums = weights @ by_run
    ratios: np.ndarray = sums / np.maximum(sums[:, -1:], 1)
    return ratios
