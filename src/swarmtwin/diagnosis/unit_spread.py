"""In which ways units of a robot differ by fabrication, which is no gap, and how far, as a reference shows it."""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Self

import numpy as np
import torch
from scipy import optimize
from torch import Tensor

from swarmtwin.diagnosis.measured_session import MeasuredSession
from swarmtwin.diagnosis.noise import Noise
from swarmtwin.diagnosis.session_prediction import SessionPredictor
from swarmtwin.diagnosis.settings import UnitSettings
from swarmtwin.diagnosis.unlike_units import unlike_units
from swarmtwin.geometry import displacement_between, exp_map, log_map
from swarmtwin.simulation.efforts import twist_of_wheels, wheel_travel


@dataclass(frozen=True)
class UnitSpread:
    """How far a unit of a robot may differ from what a simulation answers: standard deviations, as shares.

    Attributes:
        usual: of a difference of which nothing else is known.
        known: of others, by their names in `unit_changes`.
    """

    usual: float
    known: Mapping[str, float] = field(default_factory=dict)

    def of(self, difference: str) -> float:
        """Return that of a difference."""
        return self.known.get(difference, self.usual)


@dataclass(frozen=True)
class ReferenceUnits:
    """What a reference of N transitions shows of the units that drove it.

    Attributes:
        spread: how far units differ.
        errors: (N, 3) what of the simulation's errors is each unit's own, in the frame at the end of its period: the
            simulation answers for all of them on average.
        unlike: ids of vehicles that are unlike the others by more than units differ, and in which differences.
    """

    spread: UnitSpread
    errors: np.ndarray
    unlike: Mapping[str, tuple[str, ...]] = field(default_factory=dict)

    @classmethod
    def estimate(
        cls,
        predictor: SessionPredictor,
        noise: Noise,
        errors: np.ndarray,
        session: MeasuredSession,
        twist: Tensor,
        settings: UnitSettings,
    ) -> Self:
        """Estimate how units differ, difference by difference; of one unit the spread is the prior itself.

        Of each unit that shows it every difference is estimated by least squares, all at once. The variance of a
        difference between units is the most probable one, given these estimates, how sure each is by itself over runs,
        and a prior that counts for `prior_units`; another unit differs from the mean of K of them, which the simulation
        answers for, by the root of 1 + 1/K times as much. What each has of its own is then estimated once more, within
        that spread, less what all of them share, which is the simulation's own error.

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
            return cls(UnitSpread(settings.spread), np.zeros_like(errors))
        prepared = noise.filter(twist.numpy(), session)
        residual, end = prepared(errors[..., None])[..., 0], exp_map(twist)
        differences = unit_changes(predictor, twist, session)
        moved = [log_map(displacement_between(end, exp_map(twist + one))) for one in differences.values()]
        change = torch.stack(moved, dim=-1).numpy()
        units = [_OneUnit.of(prepared(change), residual, session, vehicle) for vehicle in vehicles]
        known = {}
        for number, name in enumerate(differences):
            shown = [unit for unit in units if unit.is_shown[number]]
            if len(shown) > 1:
                own = np.array([(unit.value[number], unit.variance[number]) for unit in shown])
                known[name] = _most_probable_spread(own[:, 0], own[:, 1], settings)
        expected = np.array([known.get(name, settings.spread) for name in differences])
        values = np.array([unit.value_within(expected) for unit in units])
        shared = np.linalg.pinv(sum(unit.gram for unit in units)) @ sum(
            unit.gram @ value for unit, value in zip(units, values, strict=True)
        )
        own_errors = np.zeros_like(errors)
        for one, value in zip(units, values - shared, strict=True):
            own_errors[one.rows] = change[one.rows] @ value
        beside_their_mean = math.sqrt(1 + 1 / len(vehicles))
        spread = UnitSpread(settings.spread, {name: one * beside_their_mean for name, one in known.items()})
        names, unlike = list(differences), dict[str, tuple[str, ...]]()
        estimates = np.array([unit.value for unit in units]), np.array([unit.variance for unit in units])
        for unit, difference in unlike_units(*estimates, settings):
            vehicle = session.transitions.vehicles[vehicles[unit]]
            unlike[vehicle] = (*unlike.get(vehicle, ()), names[difference])
        return cls(spread, own_errors, unlike)


@dataclass(frozen=True)
class _OneUnit:
    """Least squares of P differences of one unit.

    Attributes:
        rows: (N,) its transitions.
        gram: (P, P) products of what the differences change, whitened.
        along: (P,) products of that with the residuals.
        is_shown: (P,) whether a difference of one, all there is, is seen at all.
        value: (P,) estimates; NaN where it is not.
        variance: (P,) of these, likewise.
    """

    rows: np.ndarray
    gram: np.ndarray
    along: np.ndarray
    is_shown: np.ndarray
    value: np.ndarray
    variance: np.ndarray

    @classmethod
    def of(cls, changes: np.ndarray, residual: np.ndarray, session: MeasuredSession, vehicle: int) -> Self:
        """Estimate from whitened changes (N, 3, P) and residuals (N, 3)."""
        rows = session.transitions.vehicle == vehicle
        change = changes * rows[:, None, None]
        gram, along = np.einsum("ndp,ndq->pq", change, change), np.einsum("ndp,nd->p", change, residual)
        is_shown = np.diag(gram) > 1.0
        value, variance = np.full((2, len(along)), np.nan)
        inverse = np.linalg.pinv(gram[np.ix_(is_shown, is_shown)])
        value[is_shown] = inverse @ along[is_shown]
        left = (residual - change[..., is_shown] @ value[is_shown]) * rows[:, None]
        by_run = session.by_run(np.einsum("ndp,nd->np", change[..., is_shown], left)) @ inverse
        variance[is_shown] = np.maximum((by_run**2).sum(axis=0), np.diag(inverse))  # of few runs the first is too small
        return cls(rows, gram, along, is_shown, value, variance)

    def value_within(self, spread: np.ndarray) -> np.ndarray:
        """Return (P,) the likeliest differences, where they are expected to spread (P,) normally about none."""
        likeliest: np.ndarray = spread * np.linalg.solve(
            np.eye(len(spread)) + spread * self.gram * spread[:, None], spread * self.along
        )
        return likeliest


def _most_probable_spread(values: np.ndarray, variances: np.ndarray, settings: UnitSettings) -> float:
    """Return the standard deviation between K units of which values (K,) are known with variances (K,).

    The mode over its log: restricted likelihood times a scaled inverse chi-squared prior (Gelman, 2006).
    """
    prior = settings.spread**2

    def cost(log: float) -> float:
        """Return twice the negative log of the posterior density, but for a constant."""
        precision = 1 / (math.exp(log) + variances)
        away = values - precision @ values / precision.sum()
        likelihood = float(np.log(precision).sum() - precision @ away**2 - math.log(precision.sum()))
        return settings.prior_units * (log + prior * math.exp(-log)) - likelihood

    around = math.log(prior) + np.linspace(-12.0, 12.0, 97)
    nearest = around[np.argmin([cost(log) for log in around])]
    found = optimize.minimize_scalar(cost, bounds=(nearest - 0.25, nearest + 0.25), method="bounded")
    return math.exp(found.x / 2)


def unit_changes(
    predictor: SessionPredictor, twist: Tensor, session: MeasuredSession, commands: tuple[Tensor, Tensor] | None = None
) -> dict[str, Tensor]:
    """Return by what simulated twists (N, 3) change, per unit of each difference that a unit may have, by its name.

    It goes, slides and turns farther, left and right differ, what steers is askew, the time constant with which it
    follows is longer, and its actuators start to move at a smaller command.

    Args:
        predictor: of the simulation.
        twist: of which differences are looked at.
        session: of N transitions.
        commands: (N, m) in force now and before; None: as they were sent.
    """
    given, conditions = session.situation, session.conditions
    if commands is None:
        assert given.command is not None
        assert given.previous_command is not None
        commands = given.command, given.previous_command
    changes = {}
    for axis, name in enumerate(("ahead", "aside", "turn")):
        changes[name] = torch.zeros_like(twist)
        changes[name][:, axis] = twist[:, axis]
    actuation, track_mm = session.transitions.robot.actuation, conditions.track_mm
    if actuation.kind == "wheel" and track_mm:
        apart = wheel_travel(twist, track_mm) * torch.tensor([[0.5, -0.5]], dtype=twist.dtype)
        changes["left_to_right"] = twist_of_wheels(apart, torch.zeros_like(twist), track_mm)
    if actuation.steering:
        step_rad = 0.05  # small beside any steering range, large beside float32
        askew = _by_other_commands(predictor, session, commands, (actuation.steering,), math.degrees(step_rad))
        changes["askew"] = askew / step_rad
    if any(conditions.own_lags):
        now, before = (predictor.base_twist(command, command) for command in commands)
        changes["lag"] = torch.tensor(conditions.own_lags, dtype=twist.dtype) * (before - now)
    return changes | _starts(predictor, twist, session, commands)


def _by_other_commands(
    predictor: SessionPredictor,
    session: MeasuredSession,
    commands: tuple[Tensor, Tensor],
    columns: Sequence[str],
    step: float,
) -> Tensor:
    """Return by what simulated twists (N, 3) change where columns of the commands now and before are larger."""
    others = [command.clone() for command in commands]
    for column in columns:
        for command in others:
            command[:, session.transitions.robot.command_columns.index(column)] += step
    return predictor.base_twist(*others) - predictor.base_twist(*commands)


def _starts(
    predictor: SessionPredictor, twist: Tensor, session: MeasuredSession, commands: tuple[Tensor, Tensor]
) -> dict[str, Tensor]:
    """Return by what simulated twists (N, 3) change where a unit's actuators start to move at a smaller command.

    Wheels are faster by as much at any speed, per unit of the root mean square of their own; what thrusts does as if
    its effort were larger, per unit of that of the efforts.
    """
    actuation, track_mm = session.transitions.robot.actuation, session.conditions.track_mm
    if actuation.effort and actuation.kind == "thrust":
        places = [session.transitions.robot.command_columns.index(column) for column in actuation.effort]
        usual = float(commands[0][:, places].square().mean().sqrt())
        if not usual:  # nothing is driven
            return {"start": torch.zeros_like(twist)}
        step = 0.02 * usual
        return {"start": _by_other_commands(predictor, session, commands, actuation.effort, step) * usual / step}
    if actuation.kind == "wheel" and track_mm:
        faster, sides = _of_one_size(wheel_travel(twist, track_mm)), {"": [1.0, 1.0], "_left_to_right": [0.5, -0.5]}
        return {
            f"start{name}": twist_of_wheels(faster * faster.new_tensor([side]), torch.zeros_like(twist), track_mm)
            for name, side in sides.items()
        }
    ahead = torch.zeros_like(twist)
    ahead[:, :1] = _of_one_size(twist[:, :1])
    return {"start": ahead}


def _of_one_size(way: Tensor) -> Tensor:
    """Return ways (N, k) of the same sign and the size of their root mean square; those close to zero stay there."""
    usual = way.square().mean().sqrt().clamp(min=1e-9)
    return torch.tanh(4 * way / usual) * usual
