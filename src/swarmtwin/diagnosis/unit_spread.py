"""What a reference shows of how far units of its robot differ: that is no gap."""

import math

import numpy as np
import torch
from torch import Tensor

from swarmtwin.diagnosis.measured_session import MeasuredSession
from swarmtwin.diagnosis.noise import Noise
from swarmtwin.diagnosis.random_effects import unit_changes
from swarmtwin.diagnosis.session_prediction import SessionPredictor
from swarmtwin.diagnosis.settings import UnitSettings
from swarmtwin.geometry import displacement_between, exp_map, log_map


def estimated_unit_spread(
    predictor: SessionPredictor,
    noise: Noise,
    errors: np.ndarray,
    session: MeasuredSession,
    twist: Tensor,
    settings: UnitSettings,
) -> float:
    """Return the spread between units that a reference shows, shrunk towards the prior; of one unit the prior itself.

    Of each unit every difference is estimated by least squares. Their variance between units, less what the choice of
    runs adds to it (DerSimonian and Laird, 1986), is averaged over the differences and counts for the number of units
    beyond the first, against `prior_units` of the prior.

    Args:
        predictor: of the reference's own transitions, by what has not seen them.
        noise: of its residuals.
        errors: (N, 3) of what it answers without mechanisms.
        session: the reference's own transitions.
        twist: (N, 3) these answers.
        settings: the prior.
    """
    vehicles = np.unique(session.transitions.vehicle)
    if len(vehicles) < 2:
        return settings.spread
    prepared = noise.filter(twist.numpy(), session)
    residual = prepared(errors[..., None])[..., 0]
    end = exp_map(twist)
    moved = [
        log_map(displacement_between(end, exp_map(twist + one))) for one in unit_changes(predictor, twist, session)
    ]
    changes = prepared(torch.stack(moved, dim=-1).numpy())
    shows = (changes**2).sum(axis=(0, 1)) > 1.0  # a difference of one, all there is, is seen at all
    values, variances = [], []
    for vehicle in vehicles:
        own = (session.transitions.vehicle == vehicle)[:, None]
        change = (changes * own[..., None])[:, :, shows]
        inverse = np.linalg.pinv(np.einsum("ndp,ndq->pq", change, change))
        value = inverse @ np.einsum("ndp,nd->p", change, residual)
        left = (residual - change @ value) * own
        by_run = session.by_run(np.einsum("ndp,nd->np", change, left)) @ inverse
        values.append(value)
        variances.append((by_run**2).sum(axis=0))
    between = np.var(values, axis=0, ddof=1) - np.mean(variances, axis=0)
    units = len(vehicles) - 1
    total = settings.prior_units * settings.spread**2 + units * max(float(between.mean()), 0.0)
    return math.sqrt(total / (settings.prior_units + units))
