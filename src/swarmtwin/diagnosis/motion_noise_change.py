"""Step 3, its end: whether the motion is more random than the reference's, beyond what sessions differ by."""

import math
from collections.abc import Callable, Sequence
from typing import NamedTuple

import numpy as np
from scipy import special, stats

from swarmtwin.diagnosis.likelihood import SessionLikelihood, loses_commands
from swarmtwin.diagnosis.settings import DiagnosisSettings
from swarmtwin.simulation.mechanism import Mechanism

AFTER_MOTION = ("marker", "camera", "clock")
"""Stages of the signal at which a vehicle has moved: what happens there changes nothing of how it does."""


class MotionNoiseChange(NamedTuple):
    """How much more random the motion is than the reference's.

    Attributes:
        factor: on its standard deviation.
        low: lower end of its 95 % interval, which includes what sessions of one robot differ by.
        high: upper end of that interval.
        probability: that this is a cause, and no difference that two sessions of one robot have.
        usual: factor that the reference's own motion shows, measured likewise: the first one is beside it.
    """

    factor: float
    low: float
    high: float
    probability: float
    usual: float = 1.0


def motion_noise_change(
    model: SessionLikelihood, mechanisms: Sequence[Mechanism], usual_log: Callable[[], float]
) -> MotionNoiseChange:
    """Compare the motion's noise with the reference's, and where that may have changed with its own motion's.

    What the reference's own motion shows costs a pass through it: it is asked for where the noise may have changed if
    the reference shows as little as sessions differ by.
    """
    log, error = model.motion_noise_log()
    usual, expected = usual_noise_spread(model, mechanisms), expected_noise_log(model, mechanisms)

    def change(of_reference: float) -> MotionNoiseChange:
        beside = log - of_reference
        probability = noise_change_probability(beside - expected, error, usual, model.settings)
        low, high = np.exp(beside + np.array([-1.96, 1.96]) * np.hypot(error, usual))
        return MotionNoiseChange(*map(float, (np.exp(beside), low, high, probability, np.exp(of_reference))))

    may_have_changed = change(-math.copysign(usual, log - expected)).probability >= 0.5
    return change(usual_log() if may_have_changed else 0.0)


def usual_noise_spread(model: SessionLikelihood, mechanisms: Sequence[Mechanism]) -> float:
    """Return the standard deviation of the log of the noise's factor between sessions in which it is no cause.

    Of causes that leave the motion as it is, or of which each command arrives or does not, that is as without causes.
    """
    settings = model.settings.motion_noise
    moved = [one for one in mechanisms if one.stage not in AFTER_MOTION and not loses_commands([type(one)])]
    usual = settings.usual_spread_beside if moved or model.unknown_vehicles else settings.usual_spread
    if model.has_momentum:
        usual = max(usual, settings.usual_spread_with_momentum)
    driven = model.simulated.numpy()
    unlike = model.reference_noise.log_from_usual(driven), 2 * expected_noise_log(model, mechanisms)
    return float(np.linalg.norm([usual, *(settings.growth_spread * each for each in unlike)]))


def expected_noise_log(model: SessionLikelihood, mechanisms: Sequence[Mechanism]) -> float:
    """Return the log of the factor that mechanisms are expected to put on the noise, which grows with the motion.

    The reference cannot show whether it grows with how vehicles move or with what they were commanded: expected is the
    middle between both.
    """
    if not mechanisms:
        return 0.0
    commanded, moved = map(model.reference_noise.motion_variance, (model.simulated.numpy(), model.motion))
    return float(np.log(commanded / moved).mean()) / 4  # half of it for deviations, and half of the way between both


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
