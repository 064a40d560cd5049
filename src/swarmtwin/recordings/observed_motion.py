"""How recorded vehicles move and are commanded, in figures that tell whether units, axes and signs can be right."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import NamedTuple, Self

import numpy as np

from swarmtwin.geometry import displacement_between
from swarmtwin.robot import Robot


class Agreement(NamedTuple):
    """How well motion follows commands: 1 entirely, 0 not at all, −1 the other way round; None where nothing tells.

    Attributes:
        travel: share of the way that leads to where the vehicle heads, or away from there where it is told to reverse.
        turn: share of all turning that goes the way in which the command steers.
    """

    travel: float | None
    turn: float | None

    @property
    def least(self) -> float:
        """Return the worse of both; 1 where nothing tells."""
        return min((value for value in self if value is not None), default=1.0)


@dataclass(frozen=True)
class ObservedMotion:
    """P pairs of successive rows, about a control period apart, with known poses.

    Attributes:
        robot: whose they are.
        commands: (2 k + 1, P, m) held in each pair: of the k rows before, of its own row, of the k rows after; NaN
            where there is none.
        start: (P, 3) poses as recorded.
        end: (P, 3) one row later.
    """

    robot: Robot
    commands: np.ndarray
    start: np.ndarray
    end: np.ndarray

    def __len__(self) -> int:
        return len(self.start)

    @property
    def command(self) -> np.ndarray:
        """The commands (P, m) of the pairs' own rows."""
        own: np.ndarray = self.commands[len(self.commands) // 2]
        return own

    def with_command_of(self, offset: int) -> Self:
        """Return it with the commands that stand so many rows later, at most k, in the place of the pairs' own."""
        return replace(self, commands=np.roll(self.commands, -offset, axis=0))

    def with_commands(self, change: Callable[[np.ndarray], np.ndarray]) -> Self:
        """Return it with other commands: `change` is given and returns some (..., m)."""
        return replace(self, commands=change(self.commands))

    def with_poses(self, change: Callable[[np.ndarray], np.ndarray]) -> Self:
        """Return it with other poses: `change` is given and returns some (P, 3)."""
        return replace(self, start=change(self.start), end=change(self.end))

    @cached_property
    def displacement(self) -> np.ndarray:
        """Displacements (P, 3)."""
        return displacement_between(self.start, self.end)

    @cached_property
    def distance(self) -> np.ndarray:
        """How far each pair leads, (P,), in the unit of the poses."""
        return np.linalg.norm(self.displacement[:, :2], axis=1)

    @property
    def forward_effort(self) -> np.ndarray | None:
        """How strongly the commands drive forward, (P,), 1 being the limit; None where the file does not say."""
        actuators, effort = self.robot.actuation, self._effort(self.robot.actuation.effort)
        if actuators.effort:
            return effort.mean(axis=1)
        return self._effort(self.robot.command_columns[:1])[:, 0] if actuators.kind == "wheel" else None

    @property
    def turn_effort(self) -> np.ndarray | None:
        """How strongly the commands steer to the left, (P,), 1 being the limit; None where the file does not say."""
        actuators = self.robot.actuation
        if actuators.steering:
            return self._effort([actuators.steering])[:, 0]
        if actuators.kind == "wheel":
            wheels = self._effort(actuators.effort or self.robot.command_columns[1:2])
            if wheels.shape[1] == 2:
                return (wheels[:, 1] - wheels[:, 0]) / 2
            return wheels[:, 0] if wheels.shape[1] == 1 and not actuators.effort else None
        return None

    def _effort(self, columns: Sequence[str]) -> np.ndarray:
        chosen = [self.robot.command_columns.index(name) for name in columns]
        largest = np.maximum(np.abs(self.robot.command_low), np.abs(self.robot.command_high))
        share: np.ndarray = (self.command / largest)[:, chosen]
        return share

    def agreement(self, least_effort: float = 0.2, fewest: int = 30) -> Agreement:
        """Return how well motion follows commands, where they ask for enough and at least so many pairs move."""
        moving = self.distance > least_effort * np.quantile(self.distance, 0.95)
        forward, turn = self.displacement[:, 0], self.displacement[:, 2]
        return Agreement(
            _followed(forward, self.distance, self.forward_effort, moving, least_effort, fewest),
            _followed(turn, np.abs(turn), self.turn_effort, np.abs(turn) > 0, least_effort, fewest),
        )

    def gain(self, fewest: int = 30) -> tuple[float | None, float | None]:
        """Return how far and how much vehicles move for their commands: median shares of the largest believable motion.

        Divided by the share of the largest command: 0.3 to 1 is usual. From the stronger commands only; None where
        there are too few, or the robot's file does not say what drives and steers.
        """
        limit = self.robot.displacement_limit
        turned = np.abs(self.displacement[:, 2])
        return (
            _gain(self.distance / limit[0], self.forward_effort, fewest),
            _gain(turned / limit[2], self.turn_effort, fewest),
        )


def _followed(
    moved: np.ndarray,
    amount: np.ndarray,
    effort: np.ndarray | None,
    counts: np.ndarray,
    least_effort: float,
    fewest: int,
) -> float | None:
    if effort is None:
        return None
    counts = counts & (np.abs(effort) > least_effort)
    if counts.sum() < fewest:
        return None
    return float((np.sign(effort) * moved)[counts].sum() / amount[counts].sum())


def _gain(amount: np.ndarray, effort: np.ndarray | None, fewest: int) -> float | None:
    if effort is None:
        return None
    strength = np.abs(effort)
    strong = (strength > 0) & (strength >= np.nanquantile(strength, 0.95) / 2)
    return float(np.median(amount[strong] / strength[strong])) if strong.sum() >= fewest else None
