"""What nobody knows exactly, and is no gap: directions that a session's errors may take, with a normal prior."""

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Self

import numpy as np
import torch
from torch import Tensor

from swarmtwin.diagnosis.measured_session import MeasuredSession
from swarmtwin.diagnosis.noise import NoiseFilter
from swarmtwin.diagnosis.session_errors import SessionErrors
from swarmtwin.diagnosis.session_prediction import SessionPredictor
from swarmtwin.simulation.mechanism import Mechanism, twist_of_wheels, wheel_travel


@dataclass(frozen=True)
class RandomEffects:
    """K directions of errors, each in units of its prior standard deviation.

    Attributes:
        errors: (N, 3, K) as changes of errors.
        columns: (3 N, K) whitened.
        weighted: (3 N, K) times how much each transition counts.
        weight: (3 N,) that.
        precision: (K, K) of their sizes, posterior.
        inverse: (K, K) of it.
        log_determinant: of the precision.
    """

    errors: np.ndarray
    columns: np.ndarray
    weighted: np.ndarray
    weight: np.ndarray
    precision: np.ndarray
    inverse: np.ndarray
    log_determinant: float

    @classmethod
    def of(cls, errors: np.ndarray, whiten: NoiseFilter, weight: np.ndarray) -> Self:
        """Prepare directions (N, 3, K); transitions count `weight` (N,)."""
        flat = whiten(errors).reshape(3 * len(errors), errors.shape[-1])
        repeated = np.repeat(weight, 3)
        weighted = flat * repeated[:, None]
        return cls._of(errors, flat, weighted, repeated, np.eye(flat.shape[1]) + flat.T @ weighted)

    @classmethod
    def _of(
        cls, errors: np.ndarray, columns: np.ndarray, weighted: np.ndarray, weight: np.ndarray, precision: np.ndarray
    ) -> Self:
        inverse, log_determinant = np.linalg.inv(precision), float(np.linalg.slogdet(precision)[1])
        return cls(errors, columns, weighted, weight, precision, inverse, log_determinant)

    def extended(self, errors: np.ndarray, whiten: NoiseFilter) -> "RandomEffects":
        """Return them with further directions (N, 3, K')."""
        flat = whiten(errors).reshape(3 * len(errors), errors.shape[-1])
        weighted = flat * self.weight[:, None]
        beside = self.weighted.T @ flat
        precision = np.block([[self.precision, beside], [beside.T, np.eye(flat.shape[1]) + flat.T @ weighted]])
        return self._of(
            np.concatenate([self.errors, errors], axis=-1),
            np.column_stack([self.columns, flat]),
            np.column_stack([self.weighted, weighted]),
            self.weight,
            precision,
        )

    def sizes(self, whitened: np.ndarray) -> np.ndarray:
        """Return (K,) the likeliest sizes that whitened errors (N, 3) show."""
        sizes: np.ndarray = self.inverse @ (self.weighted.T @ whitened.ravel())
        return sizes

    def of_sizes(self, sizes: np.ndarray) -> np.ndarray:
        """Return what sizes (K,) make of whitened errors, (N, 3)."""
        return (self.columns @ sizes).reshape(-1, 3)

    def inner(self, one: np.ndarray, other: np.ndarray) -> np.ndarray:
        """Return products (p, q) of columns (3 N, p) and (3 N, q), with the effects integrated out."""
        direct = (one * self.weight[:, None]).T @ other
        product: np.ndarray = direct - (self.weighted.T @ one).T @ self.inverse @ (self.weighted.T @ other)
        return product


def simulation_effects(model: SessionErrors) -> Iterator[np.ndarray]:
    """Yield (N, 3) how the simulation's members disagree, as a jackknife over folds of runs has it."""
    members = model.members
    if members > 1:
        twists = [model.predictor.with_member(member).twist(()) for member in range(members)]
        changes = [model.changes_of(twist) for twist in twists]
        mean = np.mean(changes, axis=0)
        factor = math.sqrt((members - 1) / members)
        for change in changes:
            yield factor * (change - mean)


def smooth_functions(session: MeasuredSession) -> np.ndarray:
    """Return (N, q) polynomials of the commands now and before, of second degree, each of unit size."""
    robot, given = session.transitions.robot, session.situation
    assert given.previous_command is not None
    low, high = robot.command_low, robot.command_high
    command, previous = (2 * (one.numpy() - low) / (high - low) - 1 for one in (given.command, given.previous_command))
    columns = [np.ones(len(command)), *command.T, *previous.T]
    count = command.shape[1]
    columns += [command[:, one] * command[:, other] for one in range(count) for other in range(one + 1)]
    columns += [np.abs(command[:, one]) for one in range(count) if low[one] < 0 < high[one]]
    columns += [command[:, one] ** 3 for one in range(count)]
    functions = np.column_stack(columns)
    scaled: np.ndarray = functions / np.maximum(np.sqrt((functions**2).mean(axis=0)), 1e-9)
    return scaled


def unit_effects(model: SessionErrors) -> Iterator[np.ndarray]:
    """Yield (N, 3) what vehicles that the reference does not know may do otherwise, by fabrication."""
    if not model.strange:
        return
    transitions, center = model.session.transitions, model.predictor.twist(model.explained)
    for vehicle in model.strange:
        own = torch.as_tensor(transitions.vehicle == transitions.vehicles.index(vehicle))[:, None]
        for change in unit_changes(model.predictor, center, model.session):
            twist = center + torch.where(own, change, torch.zeros_like(change)) * model.unit_spread
            yield model.changes_of(twist, center)


def unit_changes(predictor: SessionPredictor, twist: Tensor, session: MeasuredSession) -> list[Tensor]:
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


def form_effects(model: SessionErrors, mechanisms: Sequence[Mechanism]) -> Iterator[np.ndarray]:
    """Yield (N, 3) how mechanisms may really look: what each changes, times smooth functions of the commands.

    A dead band may rescale what is left or not, a battery's curve may bend otherwise: another form of the same cause
    is neither unexplained nor a second cause. Without command loss, of which only the likeliest course is looked at.
    """
    share = model.settings.likelihood.form
    functions = smooth_functions(model.session)
    now = model.errors(mechanisms)
    for one in mechanisms:
        others = [other for other in mechanisms if other is not one]
        change = now - model.errors(others)
        if not change.any():
            continue
        for function in functions[:, 1:].T:
            yield share * change * function[:, None] / math.sqrt(functions.shape[1] - 1)
        for axis in (0, 2):
            alone = np.zeros_like(change)
            alone[:, axis] = change[:, axis]
            yield share * alone
