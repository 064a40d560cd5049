"""Step 3, its end: whether what causes do is the same in every situation, as it is of the true ones.

A cause that another one imitates does as much as that on average, but not at each time, place, heading or command: a
loss that begins at once is no battery that sags. Which other cause it is need not be known to see that. A flexible
regression must find the whole of that difference anew; this one asks with few coefficients by how much the known change
would have to be larger here and smaller there, of errors that the filter has made independent of each other.
"""

import math
from collections.abc import Iterator, Sequence

import numpy as np
from scipy import special

from swarmtwin.diagnosis.cross_fitted_ridge import CrossFittedRidge
from swarmtwin.diagnosis.likelihood import FittedMechanisms, SessionLikelihood, arriving
from swarmtwin.diagnosis.noise import log_density
from swarmtwin.diagnosis.random_effects import smooth_functions
from swarmtwin.simulation.mechanism import Mechanism


def nats_by_variation(model: SessionLikelihood, fitted: FittedMechanisms) -> float:
    """Return the nats by which errors are likelier, given how what causes do varies over time, place, heading, command.

    Each regression looks at one of these; which of them is right is not known. They are cross-fitted over runs.

    Args:
        model: of N transitions.
        fitted: the causes, and the errors that they leave. Lost commands do not vary: nobody sees when they are lost.
    """
    changes = list(changes_by_cause(model, arriving(fitted.mechanisms)))
    if not changes:
        return 0.0
    settings, freedom = model.settings.flexible, model.noise.degrees_of_freedom
    left = fitted.residual / fitted.scale
    target = np.clip(left, -settings.clip_z, settings.clip_z).ravel()
    weight, fold = np.repeat(model.weight, 3), np.repeat(model.flexible.fold, 3)
    before, nats = float(log_density(left, freedom).sum()), []
    for functions in (
        *model.flexible.modulations.values(),
        smooth_functions(model.robot, model.session.situation)[:, 1:],
    ):
        varied = np.concatenate([change[:, :, None] * functions[:, None, :] for change in changes], axis=2)
        columns = (model.filter(varied) / fitted.scale[:, None]).reshape(len(target), -1)
        (expected,) = CrossFittedRidge(columns, weight, fold, settings.ridges).answers(target)
        nats.append(float(log_density(left - expected.reshape(-1, 3), freedom).sum()) - before)
    return float(special.logsumexp(nats)) - math.log(len(nats))


def changes_by_cause(model: SessionLikelihood, mechanisms: Sequence[Mechanism]) -> Iterator[np.ndarray]:
    """Yield (N, 3) by what each of mechanisms changes the errors beside the others, but for those that change none."""
    now = model.errors(mechanisms)
    for one in mechanisms:
        change = now - model.errors([other for other in mechanisms if other is not one])
        if change.any():
            yield change
