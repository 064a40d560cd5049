"""What the simulation gets wrong of its own reference as well: learned there, expected again, and no gap."""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from swarmtwin.diagnosis.flexible_residual import random_cosines
from swarmtwin.diagnosis.measured_session import MeasuredSession
from swarmtwin.diagnosis.random_effects import RandomEffects, smooth_functions
from swarmtwin.diagnosis.session_errors import SessionErrors
from swarmtwin.simulation.mechanism import Mechanism, Parameter, offered


@dataclass(frozen=True)
class Discrepancy:
    """Errors of a simulation as a sum of q functions: smooth ones of the commands, and what mechanisms would do.

    A learned simulation rounds the corner of a dead band, and is uncertain where commands are rare. In a mechanism's
    own direction that looks like the mechanism, so these directions are among the functions. Where commands hold or
    hardly change it is uncertain as well: commands that are drawn anew in each period seldom do.

    Attributes:
        mechanisms: whose effect is a function each, and where commands hold another one.
        size: (q,) by which each function is divided, so that it is of the noise's size on the reference.
        mean: (q,) coefficients that the reference shows.
        root: (q, q) a root of their posterior covariance.
    """

    mechanisms: tuple[Mechanism, ...]
    size: np.ndarray
    mean: np.ndarray
    root: np.ndarray

    @classmethod
    def learn(cls, model: SessionErrors, spread: float) -> "Discrepancy":
        """Learn from the reference's own transitions, predicted by what has not seen them.

        Args:
            model: of these.
            spread: prior standard deviation of each function's size, in units of the noise.
        """
        mechanisms = tuple(_directions(model))
        whitened = model.filter(functions(model, mechanisms))
        count = len(whitened)
        columns = whitened.reshape(3 * count, -1)
        size = np.maximum(np.sqrt((columns**2).sum(axis=0) / count), 1e-9)
        effects = RandomEffects.of(columns / size * spread, model.weight)
        mean = spread * effects.sizes(model.filter(model.errors(())[..., None])[..., 0])
        values, vectors = np.linalg.eigh(effects.inverse)
        return cls(mechanisms, size, mean, spread * vectors * np.sqrt(np.maximum(values, 0.0)))

    def expected(self, model: SessionErrors) -> tuple[np.ndarray, np.ndarray]:
        """Return the errors (N, 3) to be expected in a session, and directions (N, 3, q) of their uncertainty."""
        columns = functions(model, self.mechanisms)
        columns /= self.size
        return columns @ self.mean, columns @ self.root


def functions(model: SessionErrors, mechanisms: Sequence[Mechanism]) -> np.ndarray:
    """Return (N, 3, q) the functions of a session, as changes of its errors, none of them corrected.

    Of its rows' commands: these the simulation answers, in its reference as well, whatever a log says of when they were
    sent.
    """
    session, narrow, wide = model.session, *(_where_held(model.session, width) for width in (0.1, 0.25))
    held = [_polynomials(session) * one[:, None] for one in (narrow, wide)]
    smooth = np.column_stack(
        [smooth_functions(session.transitions.robot, session.situation), _local_functions(session), *held]
    )
    count = 3 * smooth.shape[1]
    columns = np.zeros((len(smooth), 3, count + 2 * len(mechanisms)))
    for axis in range(3):
        first = axis * smooth.shape[1]
        columns[:, axis, first : first + smooth.shape[1]] = model.usual_spread[:, axis : axis + 1] * smooth
    for number, mechanism in enumerate(mechanisms):
        change = model.changes_of(model.predictor.as_recorded.twist((mechanism,)))
        columns[..., count + 2 * number] = change
        columns[..., count + 2 * number + 1] = change * wide[:, None]
    return columns


def _local_functions(session: MeasuredSession, count: int = 24, waves: float = 4.0) -> np.ndarray:
    """Return (N, count) random cosines of the command, the same in each session: errors where commands are rare."""
    command = session.transitions.robot.scaled_command(session.transitions.command)
    return random_cosines(command, count, np.random.default_rng(0), waves)


def _polynomials(session: MeasuredSession) -> np.ndarray:
    """Return (N, q) polynomials of second degree of the command, without products."""
    command = session.transitions.robot.scaled_command(session.transitions.command)
    return np.column_stack([np.ones(len(command)), command, command**2])


def _where_held(session: MeasuredSession, width: float) -> np.ndarray:
    """Return (N,) 1 where the command holds, less by a Gaussian the more it changes, in shares of its range."""
    robot, transitions = session.transitions.robot, session.transitions
    change = (transitions.command - transitions.previous_command) / (robot.command_high - robot.command_low)
    held: np.ndarray = np.exp(-(change**2).sum(axis=1) / (2 * width**2))
    return held


def _directions(model: SessionErrors, most: int = 12) -> Iterator[Mechanism]:
    """Yield mechanisms that change what follows a command or a pose, each over a grid of its parameters.

    None that ages, that is random, that lies at a place of its own, or that others are needed for.
    """
    strange = {"elapsed_s", "neighbours", "duration_s"}
    for kind in offered(model.robot, model.session.conditions).values():
        parameters = kind.parameters_of(model.robot, model.session.conditions)
        if strange & set(kind.inputs) or kind.arrival_probability is not Mechanism.arrival_probability:
            continue
        if kind.noise_factor is not Mechanism.noise_factor or any(
            one.null_value is None and one.unit == "mm" and len(parameters) > 2 for one in parameters.values()
        ):
            continue
        points = _of_plain_form(kind, parameters, kind.initial_points(model.robot, model.session.conditions))
        for index in np.unique(np.linspace(0, len(points) - 1, min(most, len(points))).round().astype(int)):
            for name, parameter in parameters.items():
                if parameter.null_value is not None:
                    yield kind.at({**points[index], **_alone(parameters, name, points[index][name])})


def _of_plain_form(
    kind: type[Mechanism], parameters: Mapping[str, Parameter], points: Sequence[Mapping[str, float]]
) -> list[dict[str, float]]:
    """Return points of a grid, each once, without what only says how a mechanism acts, and has a default."""
    fields = kind.model_fields
    kept = [name for name, one in parameters.items() if one.null_value is not None or fields[name].is_required()]
    plain = [{name: point[name] for name in kept} for point in points]
    return [point for number, point in enumerate(plain) if point not in plain[:number]]


def _alone(parameters: Mapping[str, Parameter], name: str, value: float) -> dict[str, float]:
    """Return all parameters where they do nothing but one, which is a little off where it would do nothing."""
    null = {other: one.null_value for other, one in parameters.items() if one.null_value is not None}
    return {**null, name: value if value != null[name] else parameters[name].stepped_from(value, steps=3)}
