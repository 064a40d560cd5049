"""Step 4. The smallest effect of each cause that a session would have shown: what "no gap" means."""

import math

import numpy as np
from scipy import stats

from swarmtwin.diagnosis.cause_search import needed_nats
from swarmtwin.diagnosis.left_over import Explanation
from swarmtwin.diagnosis.result import DetectionLimit
from swarmtwin.diagnosis.screening import Candidate, candidates
from swarmtwin.simulation.mechanism import offered


def detection_limits(explained: Explanation) -> tuple[DetectionLimit, ...]:
    """Return for each cause that is not there the smallest size that would have been named with a probability of 90 %.

    A cause is named where its evidence exceeds the prior odds against it, those of its probability, and the price of
    its parameters. The nats that an effect of a size brings are normal about half its squared length in units of the
    noise, all that is no gap integrated out; the length grows in proportion to the size.
    """
    model, best = explained.model, explained.best
    settings, conditions = model.settings.search, model.session.conditions
    kinds = {name: kind for name, kind in offered(model.robot, conditions).items() if model.can_show(kind)}
    needed = needed_nats(settings, len(model.session)) + math.log(settings.named_from / (1 - settings.named_from))
    limits = []
    for one in candidates(model, best.fitted, kinds):
        limit = _limit(explained, one, needed)
        if limit:
            limits.append(limit)
    least: dict[str, DetectionLimit] = {}
    for limit in limits:
        if limit.cause not in least or limit.share_of_range < least[limit.cause].share_of_range:
            least[limit.cause] = limit
    return tuple(least[name] for name in sorted(least))


def _limit(explained: Explanation, one: Candidate, needed: float, power: float = 0.9) -> DetectionLimit | None:
    model, mechanism = explained.model, one.start[-1]
    if not one.columns.shape[1]:
        return None
    parameters = type(mechanism).parameters_of(model.robot, model.session.conditions)
    name = next((key for key, parameter in parameters.items() if parameter.null_value is not None), None)
    if name is None:
        return None
    parameter = parameters[name]
    assert parameter.null_value is not None
    length2 = float(model.effects.inner(one.columns[:, :1], one.columns[:, :1])[0, 0])
    if length2 <= 0 or one.probe == 0:
        return None
    precision = length2 / one.probe**2
    occam = 0.5 * math.log(max(precision * parameter.size**2 / (2 * math.pi), 1.0))
    size = (math.sqrt(2 * (needed + occam)) + float(stats.norm.ppf(power))) / math.sqrt(precision)
    if size >= parameter.size:
        return DetectionLimit(cause=one.name, parameter=name, value=None, unit=parameter.unit, share_of_range=1.0)
    sign = -1.0 if parameter.null_value + size > parameter.high else 1.0
    return DetectionLimit(
        cause=one.name,
        parameter=name,
        value=float(parameter.null_value + sign * size),
        unit=parameter.unit,
        share_of_range=float(np.clip(size / parameter.size, 0.0, 1.0)),
    )
