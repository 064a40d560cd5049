"""Step 1. Which vehicles of a reference are unlike the others, by more than units of a robot differ."""

from collections.abc import Sequence

import numpy as np
from scipy import stats

from swarmtwin.diagnosis.settings import UnitSettings


def unlike_units(values: np.ndarray, variances: np.ndarray, settings: UnitSettings) -> Sequence[tuple[int, int]]:
    """Return which of K units is unlike the others in which of P differences, the clearest first.

    Each is held against the mean of the others. How far these spread, with the prior, which counts for `prior_units`,
    is the scale of a Student's t; that it is as far away by chance must be less probable than `unlike_level`, over all
    that is looked at (Bonferroni).

    Args:
        values: (K, P) estimates; NaN where a unit does not show a difference.
        variances: (K, P) of these.
        settings: the prior.
    """
    shown = np.isfinite(values)
    shown &= shown.sum(axis=0) > 2  # of two nobody knows which one it is
    value, variance = np.where(shown, values, 0.0), np.where(shown, variances, 0.0)
    count = np.maximum(shown.sum(axis=0) - 1, 1)  # of the others
    mean = (value.sum(axis=0) - value) / count
    squares = (value**2).sum(axis=0) - value**2 - count * mean**2
    freedom = settings.prior_units + count - 1
    spread = (settings.prior_units * settings.spread**2 + np.maximum(squares, 0.0)) / freedom
    away = np.abs(value - mean) / np.sqrt(spread * (1 + 1 / count) + variance)
    chance = np.where(shown, 2 * stats.t.sf(away, freedom), 1.0)
    found = np.argwhere(chance * shown.sum() < settings.unlike_level)
    return sorted(((int(unit), int(difference)) for unit, difference in found), key=lambda one: chance[one])
