"""Step 3, its end: whether the reference, where it was driven as the session was, shows what causes explain as well."""

from collections.abc import Sequence

import numpy as np

from swarmtwin.diagnosis.likelihood import SessionLikelihood, arriving
from swarmtwin.simulation.mechanism import Mechanism


def nats_beyond_reference(model: SessionLikelihood, own: SessionLikelihood, mechanisms: Sequence[Mechanism]) -> float:
    """Return the nats by which a session tells more of mechanisms than its reference does where it was driven alike.

    What a simulation learned from few transitions it gets wrong, often all its members alike: it rounds what changes
    quickly. A session that stays among such commands shows the same error again and again, and where that looks like a
    mechanism, the reference's own transitions among these commands show it too, be they few. So the share of the
    mechanisms' change that is in the session's errors is compared with that in the errors of the reference, predicted
    by what has not seen them, and both are uncertain.

    Args:
        model: of the session.
        own: of the reference's own transitions.
        mechanisms: with their values.
    """
    present = arriving(mechanisms)
    errors = model.whitened([])
    change = (model.whitened(present) - errors).ravel()
    along, side = model.effects.least_squares(change[:, None], errors.ravel())
    nearest = model.settings.reference.overlap_neighbours
    weight = np.repeat(own.weight * model.session.covariate_overlap(own.session, nearest), 3)
    own_errors = own.whitened([])
    change = (own.whitened(present) - own_errors).ravel()
    own_along = float(weight @ change**2)
    if along[0, 0] <= 1e-9 or own_along <= 1e-9:
        return np.inf
    shares = -float(side[0]) / along[0, 0], -float(weight @ (change * own_errors.ravel())) / own_along
    variance = 1 / along[0, 0] + float(weight**2 @ change**2) / own_along**2
    return float((shares[0] - shares[1]) ** 2 / variance / 2)
