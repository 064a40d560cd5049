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
    given = model.session.situation
    assert given.command is not None
    assert given.previous_command is not None
    yield from _unit_effects(model, model.predictor.twist(model.explained), (given.command, given.previous_command))


def unit_effects_of_outcomes(model: SessionErrors) -> np.ndarray:
    """Return (N, 3, 4, K) these effects by which commands arrived, of the simulation without mechanisms."""
    twists, commands = model.predictor.outcomes(()), model.predictor.outcome_commands()
    outcomes = [
        list(_unit_effects(model, twist, given)) if model.strange else []
        for twist, given in zip(twists, commands, strict=True)
    ]
    empty = np.zeros((len(model.session), 3, 0))
    return np.stack([np.stack(effects, axis=-1) if effects else empty for effects in outcomes], axis=2)


def _unit_effects(model: SessionErrors, center: Tensor, commands: tuple[Tensor, Tensor]) -> Iterator[np.ndarray]:
    """Yield (N, 3) what strange vehicles may do otherwise than twists (N, 3) under commands now and before."""
    transitions = model.session.transitions
    for vehicle in model.strange:
        own = torch.as_tensor(transitions.vehicle == transitions.vehicles.index(vehicle))[:, None]
        changes = unit_changes(model.predictor, center, model.session, commands)
        for change in changes + unit_starts(center, model.session):
            twist = center + torch.where(own, change, torch.zeros_like(change)) * model.unit_spread
            yield model.changes_of(twist, center)


def unit_changes(
    predictor: SessionPredictor, twist: Tensor, session: MeasuredSession, commands: tuple[Tensor, Tensor] | None = None
) -> list[Tensor]:
    """Return by what simulated twists (N, 3) change, per unit of each difference that a unit may have.

    Args:
        predictor: of the simulation.
        twist: of which differences are looked at.
        session: of N transitions.
        commands: (N, m) in force now and before; None: as they were sent.
    """
    changes = []
    for axis in range(3):
        change = torch.zeros_like(twist)
        change[:, axis] = twist[:, axis]
        changes.append(change)
    if commands is None:
        assert session.situation.command is not None
        assert session.situation.previous_command is not None
        commands = session.situation.command, session.situation.previous_command
    actuation, track_mm = session.transitions.robot.actuation, session.conditions.track_mm
    if actuation.kind == "wheel" and track_mm:
        apart = wheel_travel(twist, track_mm) * torch.tensor([[0.5, -0.5]], dtype=twist.dtype)
        changes.append(twist_of_wheels(apart, torch.zeros_like(twist), track_mm))
    if actuation.steering:
        column = session.transitions.robot.command_columns.index(actuation.steering)
        step_rad = 0.05  # small beside any steering range, large beside float32
        askew = [command.clone() for command in commands]
        for command in askew:
            command[:, column] += math.degrees(step_rad)
        changes.append((predictor.base_twist(*askew) - twist) / step_rad)
    return changes


def unit_starts(twist: Tensor, session: MeasuredSession) -> list[Tensor]:
    """Return by what simulated twists (N, 3) change where a unit's actuators start to move at a smaller command.

    They are faster by as much at any speed: per unit of the root mean square of their own.
    """
    track_mm = session.conditions.track_mm
    if session.transitions.robot.actuation.kind == "wheel" and track_mm:
        faster = _of_one_size(wheel_travel(twist, track_mm))
        sides = (torch.tensor(side, dtype=twist.dtype) for side in ([[1.0, 1.0]], [[0.5, -0.5]]))
        return [twist_of_wheels(faster * side, torch.zeros_like(twist), track_mm) for side in sides]
    ahead = torch.zeros_like(twist)
    ahead[:, :1] = _of_one_size(twist[:, :1])
    return [ahead]


def _of_one_size(way: Tensor) -> Tensor:
    """Return ways (N, k) of the same sign and the size of their root mean square; those close to zero stay there."""
    usual = way.square().mean().sqrt().clamp(min=1e-9)
    return torch.tanh(4 * way / usual) * usual


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
