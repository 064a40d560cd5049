"""Two units of one robot are never quite alike: what differs by fabrication is no gap."""

import math

import numpy as np
import torch
from torch import Tensor

from swarmtwin.diagnosis.measured_session import MeasuredSession
from swarmtwin.diagnosis.noise import Noise, Whitener
from swarmtwin.diagnosis.one_step import OneStepPredictor
from swarmtwin.diagnosis.settings import UnitSettings
from swarmtwin.simulation.mechanism import twist_of_wheels, wheel_travel


class UnitDifferences:
    """What vehicles that the reference does not know may do otherwise, as directions that residuals may take.

    Each has its own speeds ahead, to the side and turning, and its own difference of left and right or trim. Residuals
    are freed of what these explain best, at the price that their size has under the expected spread between units: a
    Gaussian prior, integrated out.

    Args:
        predictor: of the session, by the simulation.
        whitener: standardises the session's residuals.
        session: of N transitions.
        twist: (N, 3) simulated.
        known: ids of the vehicles that the reference knows; their differences are no fabrication.
        spread: expected standard deviation of each difference, as a share; of a trim in rad.

    Attributes:
        count: how many directions there are: 0 where the reference knows all vehicles.
    """

    def __init__(
        self,
        predictor: OneStepPredictor,
        whitener: Whitener,
        session: MeasuredSession,
        twist: Tensor,
        known: tuple[str, ...],
        spread: float,
    ) -> None:
        transitions = session.transitions
        strange = [index for index in np.unique(transitions.vehicle) if transitions.vehicles[index] not in known]
        directions = []
        for vehicle in strange:
            own = torch.as_tensor(transitions.vehicle == vehicle)[:, None]
            for change in unit_changes(predictor, twist, session):
                moved = whitener(torch.where(own, change, torch.zeros_like(change)))
                directions.append(moved.numpy().ravel() * spread)
        self.count = len(directions)
        self._directions = np.stack(directions, axis=-1) if directions else np.empty((3 * len(session), 0))
        information = self._directions.T @ self._directions
        self._inverse = np.linalg.inv(information + np.eye(self.count))

    def free(self, residual: np.ndarray) -> tuple[np.ndarray, float]:
        """Return residuals (N, 3) without what differences of units explain, and the price of that in nats."""
        if not self.count:
            return residual, 0.0
        sizes = self._inverse @ (self._directions.T @ residual.ravel())
        return residual - (self._directions @ sizes).reshape(residual.shape), float(sizes @ sizes) / 2


def unit_changes(predictor: OneStepPredictor, twist: Tensor, session: MeasuredSession) -> list[Tensor]:
    """Return by what simulated twists (N, 3) change, per unit of each difference that a unit may have."""
    changes = []
    for axis in range(3):
        change = torch.zeros_like(twist)
        change[:, axis] = twist[:, axis]
        changes.append(change)
    situation = session.situation
    actuation, track_mm = session.transitions.robot.actuation, session.conditions.track_mm
    if actuation.kind == "wheel" and track_mm:
        apart = wheel_travel(twist, track_mm) * torch.tensor([[0.5, -0.5]], dtype=twist.dtype)
        changes.append(twist_of_wheels(apart, torch.zeros_like(twist), track_mm))
    if actuation.steering:
        column = session.transitions.robot.command_columns.index(actuation.steering)
        step_rad = 0.05  # small beside any steering range, large beside float32
        assert situation.previous_command is not None
        askew = [command.clone() for command in (situation.command, situation.previous_command)]
        for command in askew:
            command[:, column] += math.degrees(step_rad)
        changes.append((predictor.base_twist(*askew) - twist) / step_rad)
    return changes


def estimated_unit_spread(
    predictor: OneStepPredictor, noise: Noise, session: MeasuredSession, twist: Tensor, settings: UnitSettings
) -> float:
    """Return the spread between units that a reference shows, shrunk towards the prior; of one unit the prior itself.

    Of each unit every difference is estimated by least squares. Their variance between units, less what the choice of
    runs adds to it (DerSimonian and Laird, 1986), is averaged over the differences and counts for the number of units
    beyond the first, against `prior_units` of the prior.

    Args:
        predictor: of the reference's own transitions, by what has not seen them.
        noise: of its residuals.
        session: the reference's own transitions.
        twist: (N, 3) what it answers without mechanisms.
        settings: the prior.
    """
    vehicles = np.unique(session.transitions.vehicle)
    if len(vehicles) < 2:
        return settings.spread
    whitener = noise.whitener(twist, session)
    residual = whitener(session.residual_of(twist)).numpy()
    changes = np.stack([whitener(change).numpy() for change in unit_changes(predictor, twist, session)], axis=-1)
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
