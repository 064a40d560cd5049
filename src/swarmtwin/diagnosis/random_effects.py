"""What nobody knows exactly, and is no gap: directions that a session's errors may take, with a normal prior."""

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Self

import numpy as np
import torch
from torch import Tensor

from swarmtwin.diagnosis.session_errors import SessionErrors
from swarmtwin.diagnosis.settings import LikelihoodSettings
from swarmtwin.diagnosis.unit_spread import unit_changes
from swarmtwin.learning.situation import Situation
from swarmtwin.robot import Robot
from swarmtwin.simulation.mechanism import Mechanism


@dataclass(frozen=True)
class RandomEffects:
    """K directions of errors, each in units of its prior standard deviation.

    Attributes:
        columns: (3 N, k) whitened, in one or more blocks, of K columns together; one column after the other in memory,
            which makes products with them twice as quick.
        weight: (3 N,) how much each transition counts.
        precision: (K, K) of their sizes, posterior.
        inverse: (K, K) of it.
        log_determinant: of the precision.
    """

    columns: tuple[np.ndarray, ...]
    weight: np.ndarray
    precision: np.ndarray
    inverse: np.ndarray
    log_determinant: float

    @classmethod
    def of(cls, columns: np.ndarray, weight: np.ndarray) -> Self:
        """Prepare directions (3 N, K), whitened; transitions count `weight` (N,)."""
        repeated = np.repeat(weight, 3)
        precision = np.eye(columns.shape[1]) + columns.T @ (columns * repeated[:, None])
        return cls._of((columns,), repeated, precision)

    @classmethod
    def _of(cls, columns: tuple[np.ndarray, ...], weight: np.ndarray, precision: np.ndarray) -> Self:
        inverse, log_determinant = np.linalg.inv(precision), float(np.linalg.slogdet(precision)[1])
        in_memory = tuple(np.asfortranarray(block) for block in columns)
        return cls(in_memory, weight, precision, inverse, log_determinant)

    def extended(self, columns: np.ndarray) -> "RandomEffects":
        """Return them with further directions (3 N, K'), whitened."""
        weighted = columns * self.weight[:, None]
        beside, own = self._along(weighted), np.eye(columns.shape[1]) + columns.T @ weighted
        precision = np.block([[self.precision, beside], [beside.T, own]])
        return self._of((*self.columns, columns), self.weight, precision)

    def sizes(self, whitened: np.ndarray) -> np.ndarray:
        """Return (K,) the likeliest sizes that whitened errors (N, 3) show."""
        sizes: np.ndarray = self.inverse @ self._along(self.weight * whitened.ravel())
        return sizes

    def of_sizes(self, sizes: np.ndarray) -> np.ndarray:
        """Return what sizes (K,) make of whitened errors, (N, 3)."""
        return self._of_sizes(sizes).reshape(-1, 3)

    def gram(self, columns: np.ndarray) -> np.ndarray:
        """Return the products (p, p) of columns (3 N, p) with each other, the effects integrated out."""
        weighted = columns * self.weight[:, None]
        along = self._along(weighted)
        product: np.ndarray = weighted.T @ columns - along.T @ self.inverse @ along
        return product

    def loss(self, whitened: np.ndarray) -> float:
        """Return the sum of squares of whitened errors (3 N,), the effects integrated out."""
        return float(self.gram(whitened[:, None])[0, 0])

    def beyond(self, columns: np.ndarray) -> np.ndarray:
        """Return columns (3 N, p), weighted, less what the effects take over: what their products are made with."""
        weighted = columns * self.weight[:, None]
        sizes = self.inverse @ self._along(weighted)
        beyond: np.ndarray = weighted - self.weight[:, None] * self._of_sizes(sizes)
        return beyond

    def least_squares(self, columns: np.ndarray, errors: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return the products (p, p) of columns (3 N, p), and those (p,) with errors (3 N,), likewise."""
        gram = self.gram(np.column_stack([columns, errors]))
        return gram[:-1, :-1], gram[:-1, -1]

    def _of_sizes(self, sizes: np.ndarray) -> np.ndarray:
        """Return the sums (3 N, ...) of the directions times sizes (K, ...)."""
        ends = np.cumsum([block.shape[1] for block in self.columns])
        parts = zip(self.columns, np.split(sizes, ends[:-1]), strict=True)
        total: np.ndarray = sum(block @ part for block, part in parts)
        return total

    def _along(self, weighted: np.ndarray) -> np.ndarray:
        """Return the products (K, ...) of the directions with columns (3 N, ...) that are weighted."""
        return np.concatenate([block.T @ weighted for block in self.columns])


def member_disagreement(model: SessionErrors, mechanisms: Sequence[Mechanism] = ()) -> np.ndarray:
    """Return (N, 3, M) how the simulation's M members disagree, as a jackknife over folds of runs has it.

    The sum of the squares of these is the variance of what the simulation gets wrong for want of data.

    Args:
        model: of N transitions.
        mechanisms: with which each member is asked: these may lead back to where the simulation has learned.
    """
    members = model.members
    if members < 2:
        return np.zeros((len(model.session), 3, 0))
    twists = (model.predictor.with_member(member).twist(mechanisms) for member in range(members))
    changes = np.stack([model.changes_of(twist) for twist in twists], axis=-1)
    disagreement: np.ndarray = math.sqrt((members - 1) / members) * (changes - changes.mean(axis=-1, keepdims=True))
    return disagreement


def smooth_functions(robot: Robot, given: Situation) -> np.ndarray:
    """Return (N, q) polynomials of the commands now and before, of second degree, each of unit size."""
    assert given.previous_command is not None
    low, high = robot.command_low, robot.command_high
    command, previous = (robot.scaled_command(one.numpy()) for one in (given.command, given.previous_command))
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
    if not model.unknown_vehicles:
        return
    given = model.session.situation
    assert given.command is not None
    assert given.previous_command is not None
    yield from _unit_effects(model, model.predictor.twist(model.explained), (given.command, given.previous_command))


def likeliest_unit_errors(model: SessionErrors, directions: np.ndarray, errors: np.ndarray) -> np.ndarray:
    """Return (N, 3) what of errors (N, 3) vehicles that the reference does not know make by fabrication, most likely.

    By least squares within the prior, in which an error that is many deviations from it (`flexible.clip_z`) counts no
    more than one that is so many.

    Args:
        model: of N transitions.
        directions: (N, 3, K) what these vehicles may do otherwise, as `unit_effects` has it.
        errors: of the simulation.
    """
    if not directions.shape[-1]:
        return np.zeros_like(errors)
    prepared = model.reference_noise.filter(model.simulated.numpy(), model.session)
    columns, whitened = prepared(directions).reshape(errors.size, -1), prepared(errors[..., None])[..., 0]
    left, most = np.zeros_like(whitened), model.settings.flexible.clip_z
    for _ in range(3):
        weight = most / np.maximum(np.abs(left).max(axis=1), most)
        effects = RandomEffects.of(columns, weight)
        sizes = effects.sizes(whitened)
        left = whitened - effects.of_sizes(sizes)
    likeliest: np.ndarray = directions @ sizes
    return likeliest


def unit_effects_of_outcomes(model: SessionErrors) -> np.ndarray:
    """Return (N, 3, 4, K) these effects by which commands arrived, of the simulation without mechanisms."""
    twists, commands = model.predictor.outcomes(()), model.predictor.outcome_commands()
    outcomes = [
        list(_unit_effects(model, twist, given)) if model.unknown_vehicles else []
        for twist, given in zip(twists, commands, strict=True)
    ]
    empty = np.zeros((len(model.session), 3, 0))
    return np.stack([np.stack(effects, axis=-1) if effects else empty for effects in outcomes], axis=2)


def _unit_effects(model: SessionErrors, center: Tensor, commands: tuple[Tensor, Tensor]) -> Iterator[np.ndarray]:
    """Yield (N, 3) what strange vehicles may do otherwise than twists (N, 3) under commands now and before."""
    transitions = model.session.transitions
    for vehicle in model.unknown_vehicles:
        own = torch.as_tensor(transitions.vehicle == transitions.vehicles.index(vehicle))[:, None]
        for name, change in unit_changes(model.predictor, center, model.session, commands).items():
            twist = center + torch.where(own, change, torch.zeros_like(change)) * model.unit_spread.of(name)
            yield model.changes_of(twist, center)


def form_effects(
    model: SessionErrors,
    mechanisms: Sequence[Mechanism],
    near: Sequence[Mechanism] | None = None,
    of_values: bool = False,
) -> Iterator[np.ndarray]:
    """Yield (N, 3) how mechanisms may really look: what each changes, times smooth functions of the commands.

    A dead band may rescale what is left or not, a battery's curve may bend otherwise: another form of the same cause
    is neither unexplained nor a second cause. Without command loss, of which only the likeliest course is looked at.

    Args:
        model: of N transitions.
        mechanisms: with values.
        near: those from which one member of the simulation says what each changes; None: all members say it.
        of_values: whether it is the values' intervals that they are for.
    """
    functions = smooth_functions(model.robot, model.session.situation)

    def errors(of: Sequence[Mechanism]) -> np.ndarray:
        return model.errors(of) if near is None else model.errors_near(of, near)

    now = errors(mechanisms)
    for one in mechanisms:
        others = [other for other in mechanisms if other is not one]
        change = now - errors(others)
        if change.any():
            yield from other_forms(one, change, functions, model.robot, model.settings.likelihood, of_values)


def other_forms(
    mechanism: Mechanism,
    change: np.ndarray,
    functions: np.ndarray,
    robot: Robot,
    settings: LikelihoodSettings,
    of_values: bool = False,
) -> Iterator[np.ndarray]:
    """Yield (N, 3) by what another form of a mechanism may differ, which changes (N, 3) of motion, by functions (N, q).

    How actuators of thrust follow is known least: their forms differ by more, and to the side as well. So do those of
    wheels where it is the values' intervals that they are for: how much their gears rub is read to half of it, and a
    motor that takes up play, without its wheel, runs faster.
    """
    is_known_least = robot.actuation.kind == "thrust" or (of_values and mechanism.stage == "actuators")
    is_rough = mechanism.says_when and is_known_least
    share, axes = (settings.rough_form, (0, 1, 2)) if is_rough else (settings.form, (0, 2))
    for function in functions[:, 1:].T:
        yield share * change * function[:, None] / math.sqrt(functions.shape[1] - 1)
    for axis in axes:
        alone = np.zeros_like(change)
        alone[:, axis] = change[:, axis]
        yield share * alone
