"""Step 1. Which vehicles of a reference are unlike the others, by more than units of a robot differ."""

import math
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
    shown = np.isfinite(values) & (np.isfinite(values).sum(axis=0) > 2)  # of two nobody knows which one it is
    tests = int(shown.sum())
    found = []
    for unit, difference in zip(*np.nonzero(shown), strict=True):
        others = shown[:, difference] & (np.arange(len(values)) != unit)
        beside, count = values[others, difference], int(others.sum())
        freedom = settings.prior_units + count - 1
        spread = (settings.prior_units * settings.spread**2 + ((beside - beside.mean()) ** 2).sum()) / freedom
        scale = math.sqrt(spread * (1 + 1 / count) + variances[unit, difference])
        away = abs(values[unit, difference] - beside.mean()) / scale
        chance = 2 * float(stats.t.sf(away, freedom))
        if chance * tests < settings.unlike_level:
            found.append((chance, int(unit), int(difference)))
    return [(unit, difference) for _, unit, difference in sorted(found)]
