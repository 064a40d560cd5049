"""What a mechanism is: a named physical cause with few bounded parameters, and the one place where it acts.

A mechanism overrides the hooks of its place and leaves the others alone; `motion.py` runs the hooks of all mechanisms
of an extended simulation in the order of the signal's way: link, electronics, actuators, ground, clock, camera. Tensors
are float64 unless said otherwise; N situations at a time.
"""

from abc import ABC
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, ClassVar, NamedTuple, Self, cast

import numpy as np
import torch
from torch import Tensor

from swarmtwin.gap.surroundings import Surroundings
from swarmtwin.robot import Robot, SituationPart, StrictModel


class Quantity(NamedTuple):
    """A parameter of a mechanism.

    Attributes:
        low: its lower bound.
        high: its upper bound.
        neutral: where the mechanism does nothing; None where another parameter says so.
        unit: what it is measured in; empty for a ratio.
        starts: values that a search begins from.
        step: change for which the motion's response is measured; null: a thousandth of the bounds' distance.
    """

    low: float
    high: float
    neutral: float | None
    unit: str
    starts: tuple[float, ...]
    step: float | None = None

    @property
    def size(self) -> float:
        """Distance of the bounds."""
        return self.high - self.low

    @property
    def response_step(self) -> float:
        """Change for which the motion's response is measured."""
        return self.step or 1e-3 * self.size


@dataclass(frozen=True)
class Drive:
    """N situations as a mechanism is shown them.

    Attributes:
        robot: which robot drives.
        surroundings: where and how long.
        command: (N, m) as sent.
        previous_command: (N, m) held before.
        earlier_command: (N, m) held before that; the previous one where it is not known.
        pose: (N, 3) the vehicles' true poses: x_mm, y_mm, heading_rad.
        elapsed_s: (N,) since the session began.
        duration_s: (N,) of the period.
        neighbours: (N, K, 3) relative poses, NaN where there is none.
    """

    robot: Robot
    surroundings: Surroundings
    command: Tensor
    previous_command: Tensor
    earlier_command: Tensor
    pose: Tensor
    elapsed_s: Tensor
    duration_s: Tensor
    neighbours: Tensor

    @property
    def progress(self) -> Tensor:
        """Share of the session that has passed, (N,) in [0, 1]."""
        return (self.elapsed_s / self.surroundings.session_s).clamp(0.0, 1.0)


class Responses(NamedTuple):
    """How far N vehicles go in one nominal period, as ways along an arc, each (N, 3): forward_mm, left_mm, turn_rad.

    Attributes:
        now: under the command, after the previous one.
        settled: under the command for long.
        before: under the previous command for long.
        earlier: under the command before that one for long; the same as `before` where it is not known.
    """

    now: Tensor
    settled: Tensor
    before: Tensor
    earlier: Tensor


class Places(NamedTuple):
    """Where in the arena the grip seems to be another one.

    Attributes:
        position: (N, 2) mm, the middle of each transition.
        slope: (N,) how the log-likelihood of each would change with a loss of grip there, per unit of loss.
        curvature: (N,) how fast that slope falls.
    """

    position: np.ndarray
    slope: np.ndarray
    curvature: np.ndarray


class Mechanism(StrictModel, ABC):
    """A cause of the catalogue (DESIGN section 8) with values for its parameters, which are its fields.

    Attributes:
        name: of the cause, that of its file.
        words: what it is, for a person; parameters in braces.
        remedy: what to repair or check.
        quantities: its parameters by field name.
        needs: parts of the situation that it looks at beside the command.
        uses_history: whether it asks how the previous command goes on.
        is_smooth: whether the motion changes gradually with the parameters.
        widening: by how much its intervals are wider than the likelihood says: it only approximates what it stands for.
            Found on stand-ins, in sessions other than those that coverage is reported for.
        leaves: share of its gain that it may leave to others that look like it, for the same reason.
    """

    words: ClassVar[str]
    remedy: ClassVar[str]
    quantities: ClassVar[Mapping[str, Quantity]]
    needs: ClassVar[tuple[SituationPart, ...]] = ()
    uses_history: ClassVar[bool] = False
    is_smooth: ClassVar[bool] = True
    widening: ClassVar[float] = 1.1
    leaves: ClassVar[float] = 0.04

    name: str

    @classmethod
    def suits(cls, robot: Robot, surroundings: Surroundings) -> bool:
        """Say whether it makes sense for a robot."""
        return True

    @classmethod
    def quantities_of(cls, robot: Robot) -> Mapping[str, Quantity]:
        """Return its parameters for a robot, by name."""
        return cls.quantities

    @classmethod
    def at(cls, values: Mapping[str, float]) -> Self:
        """Return it with values, unchecked: for searches."""
        content: dict[str, Any] = {"name": cls.model_fields["name"].default, **values}
        return cast(Self, cls.model_construct(**content))

    @classmethod
    def observed(cls, duration_s: np.ndarray, period_s: float) -> dict[str, float] | None:
        """Return fields that are read off the session's clock instead of fitted; None where the clock shows nothing."""
        return {}

    def values(self) -> dict[str, float]:
        """Return its parameters' values by name."""
        return {name: value for name, value in self if name != "name" and value is not None}

    @classmethod
    def overrides(cls, hook: str) -> bool:
        """Say whether it acts at a place."""
        return getattr(cls, hook) is not getattr(Mechanism, hook)

    def arriving(self, responses: Responses, drive: Drive) -> list[tuple[float, Responses]]:
        """Link: what arrives of the command, as alternatives with their probabilities."""
        return [(1.0, responses)]

    def received(self, command: Tensor, drive: Drive) -> Tensor:
        """Electronics: what they make of commands (N, m)."""
        return command

    def gradual(self, drive: Drive) -> list[tuple[float, float]]:
        """Electronics: shares of the period in which a part of the old command is still left: (share, part)."""
        return []

    def delivered(self, responses: Responses, drive: Drive) -> Responses:
        """Actuators: how they follow."""
        return responses

    def strength(self, drive: Drive) -> Tensor:
        """Actuators: factor on their speed, (N, 1), or (N, 2) for left and right wheels."""
        return torch.ones(1, 1, dtype=torch.float64)

    def grip(self, position: Tensor, drive: Drive) -> Tensor:
        """Ground or water: factor (N, P) on how far the actuators bring the vehicle at positions (N, P, 2)."""
        return torch.ones(1, 1, dtype=torch.float64)

    def carried_mm_s(self, way: Tensor, drive: Drive) -> Tensor:
        """Ground, water, neighbours: velocity (N, 2) along x and y of the arena, added to the vehicle's own.

        `way` (N, 3) is where the vehicle itself is going.
        """
        return torch.zeros(1, 2, dtype=torch.float64)

    def duration(self, drive: Drive) -> Tensor | None:
        """Clock: how many nominal periods (N,) the motion lasts; None: one."""
        return None

    def seen(self, pose: Tensor, surroundings: Surroundings) -> Tensor:
        """Camera: what is measured of true poses (N, 3)."""
        return pose

    def true(self, pose: Tensor, surroundings: Surroundings) -> Tensor:
        """Camera: which true poses (N, 3) are measured like this; the inverse of `seen`."""
        return pose

    def noise_factor(self) -> float:
        """Ground or water: factor on the random part of the motion."""
        return 1.0

    @classmethod
    def starts(cls, robot: Robot, surroundings: Surroundings, places: "Places | None" = None) -> list[dict[str, float]]:
        """Return where a search for its parameters begins: all combinations of the quantities' starts.

        `places` say where in the arena the actuators bring vehicles further or less far than they should.
        """
        combined: list[dict[str, float]] = [{}]
        for name, quantity in cls.quantities_of(robot).items():
            combined = [{**start, name: value} for start in combined for value in quantity.starts]
        return combined

    def reported(self) -> dict[str, float]:
        """Return its parameters as they are told; the same as `values` unless said otherwise."""
        return self.values()

    @classmethod
    def units(cls, robot: Robot) -> dict[str, str]:
        """Return the units of what `reported` gives."""
        return {name: quantity.unit for name, quantity in cls.quantities_of(robot).items()}


def wheel_ways(way: Tensor, track_mm: float) -> Tensor:
    """Return how far left and right wheel go, (N, 2) mm, on ways (N, 3)."""
    apart = way[:, 2:] * (track_mm / 2)
    return torch.cat([way[:, :1] - apart, way[:, :1] + apart], dim=-1)


def way_of_wheels(wheels: Tensor, way: Tensor, track_mm: float) -> Tensor:
    """Return the ways (N, 3) of wheels that go (N, 2) mm; what `way` (N, 3) had to the side is kept."""
    left, right = wheels[:, 0], wheels[:, 1]
    return torch.stack([(left + right) / 2, way[:, 1], (right - left) / track_mm], dim=-1)


def change_effort(command: Tensor, drive: Drive, change: Any) -> Tensor:
    """Apply `change` to the efforts in commands (N, m): the columns of the actuators, or the speeds of both wheels."""
    robot, actuation = drive.robot, drive.robot.actuation
    if actuation.effort:
        columns = [robot.command_columns.index(name) for name in actuation.effort]
        changed = command.clone()
        changed[:, columns] = change(command[:, columns])
        return changed
    half = (drive.surroundings.track_mm or 1.0) / 2
    wheels = torch.stack([command[:, 0] - half * command[:, 1], command[:, 0] + half * command[:, 1]], dim=-1)
    left, right = change(wheels).unbind(dim=-1)
    return torch.stack([(left + right) / 2, (right - left) / (2 * half)], dim=-1)


def effort_limit(robot: Robot) -> float:
    """Return the largest effort of an actuator, in the command's unit; of wheels told by speed and turn, in mm/s."""
    if robot.actuation.effort:
        return robot.command[robot.actuation.effort[0]].high
    return float(robot.command_high[0] + robot.command_high[1] * (robot.actuation.track_mm or 0.0) / 2)


def effort_unit(robot: Robot) -> str:
    """Return the unit of efforts."""
    return robot.command[robot.actuation.effort[0]].unit if robot.actuation.effort else "mm/s"
