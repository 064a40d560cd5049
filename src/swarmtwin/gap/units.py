"""Two units of one robot are never quite alike: what differs by fabrication is no gap."""

import math

import numpy as np
import torch

from swarmtwin.gap.mechanism import way_of_wheels, wheel_ways
from swarmtwin.gap.motion import Base
from swarmtwin.gap.noise import Whitener
from swarmtwin.gap.session import Session

THRUST_FACTOR = 1.5
TRIM_STEP_RAD = 0.05


class UnitDifferences:
    """What vehicles that the reference does not know may do otherwise, as directions that residuals may take.

    Each has its own speeds ahead, to the side and turning, and its own difference of left and right or trim; how much
    of that is usual stands in the robot's file (`unit_spread`). Residuals are freed of what these explain best, at the
    price that their size has under this expectation: a Gaussian prior, integrated out.
    """

    def __init__(
        self, base: Base, whitener: Whitener, session: Session, way: torch.Tensor, known: tuple[str, ...]
    ) -> None:
        robot = session.drive.robot
        transitions = session.transitions
        strange = [index for index in np.unique(transitions.vehicle) if transitions.vehicles[index] not in known]
        expected = robot.unit_spread * (THRUST_FACTOR if robot.actuation.kind == "thrust" else 1.0)
        directions = []
        for vehicle in strange:
            own = torch.as_tensor(transitions.vehicle == vehicle)[:, None]
            for change in _changes(base, way, session):
                moved = whitener(torch.where(own, change, torch.zeros_like(change)))
                directions.append(moved.numpy().ravel() * expected)
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


def _changes(base: Base, way: torch.Tensor, session: Session) -> list[torch.Tensor]:
    """Return by what ways (N, 3) change, per unit of each difference."""
    changes = []
    for axis in range(3):
        change = torch.zeros_like(way)
        change[:, axis] = way[:, axis]
        changes.append(change)
    drive = session.drive
    actuation, track_mm = drive.robot.actuation, drive.surroundings.track_mm
    if actuation.kind == "wheel" and track_mm:
        apart = wheel_ways(way, track_mm) * torch.tensor([[0.5, -0.5]], dtype=way.dtype)
        changes.append(way_of_wheels(apart, torch.zeros_like(way), track_mm))
    if actuation.steering:
        column = drive.robot.command_columns.index(actuation.steering)
        askew = [command.clone() for command in (drive.command, drive.previous_command)]
        for command in askew:
            command[:, column] += math.degrees(TRIM_STEP_RAD)
        changes.append((base.way(askew[0], askew[1], drive.pose) - way) / TRIM_STEP_RAD)
    return changes
