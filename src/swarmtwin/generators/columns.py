"""What a generator produces: the columns of a transition that matter to the robot's dynamics, side by side."""

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor

from swarmtwin.errors import UserError
from swarmtwin.geometry import wrap_angle
from swarmtwin.learning.situation import Situation
from swarmtwin.robot import DISPLACEMENT_COLUMNS, POSE_COLUMNS, Arena, Robot
from swarmtwin.transitions import Transitions


@dataclass(frozen=True)
class Columns:
    """The columns of a robot's rows: its command, its pose where its dynamics depend on it, and the displacement.

    Attributes:
        robot: whose transitions they are.
        arena_mm: where they were recorded, or are to be drawn for.
    """

    robot: Robot
    arena_mm: Arena

    @classmethod
    def of(cls, robot: Robot, arena_mm: Arena | None = None) -> "Columns":
        """Choose the columns for a robot in an arena; None: its usual one.

        Raises:
            UserError: its dynamics depend on what no generator produces.
        """
        if missing := [part for part in robot.situation if part not in ("command", "pose")]:
            raise UserError(
                f"robot {robot.name!r}: its situation has {missing[0]}, and generators produce command and pose only: "
                f"take it out of the situation in conf/robot/{robot.name}.yaml"
            )
        return cls(robot, arena_mm or robot.arena_mm)

    @property
    def has_pose(self) -> bool:
        """Whether a row holds the pose."""
        return "pose" in self.robot.situation

    @property
    def units(self) -> dict[str, str]:
        """The columns' names in order, with their units."""
        command = {name: column.unit for name, column in self.robot.command.items()}
        units = ("mm", "mm", "rad")
        pose = dict(zip(POSE_COLUMNS, units, strict=True)) if self.has_pose else {}
        return {**command, **pose, **dict(zip(DISPLACEMENT_COLUMNS, units, strict=True))}

    @property
    def width(self) -> int:
        """How many columns a row has."""
        return len(self.units)

    @property
    def situation_width(self) -> int:
        """How many of them, the first, are the situation."""
        return self.width - len(DISPLACEMENT_COLUMNS)

    @property
    def headings(self) -> list[int]:
        """The columns in rad that are periodic; a turn over one period is not."""
        return [list(self.units).index("heading_rad")] if self.has_pose else []

    def rows(self, transitions: Transitions) -> np.ndarray:
        """Return transitions as rows (N, width)."""
        pose = [transitions.pose] if self.has_pose else []
        return np.concatenate([transitions.command, *pose, transitions.displacement], axis=1)

    def split(self, rows: np.ndarray) -> "Row":
        """Take rows (N, width) apart."""
        commands = len(self.robot.command)
        pose = rows[:, commands : commands + 3] if self.has_pose else np.full((len(rows), 3), np.nan)
        return Row(rows[:, :commands], pose, rows[:, -3:])

    def situation(self, columns: Tensor) -> Situation:
        """Return the situations whose columns (N, situation_width) are given."""
        commands = len(self.robot.command)
        return Situation(command=columns[:, :commands], pose=columns[:, commands:] if self.has_pose else None)

    def euclidean(self, rows: np.ndarray) -> np.ndarray:
        """Return rows with each heading as cosine and sine, so that distances between rows mean something."""
        others = np.delete(rows, self.headings, axis=1)
        heading = rows[:, self.headings]
        return np.concatenate([others, np.cos(heading), np.sin(heading)], axis=1)

    def with_directions(self, rows: Tensor) -> Tensor:
        """Return rows (N, width) as `euclidean` does, as a tensor (N, width + headings): what networks see best."""
        heading = rows[:, self.headings]
        return torch.cat([rows[:, self._not_headings], heading.cos(), heading.sin()], dim=1)

    def with_angles(self, rows: Tensor) -> Tensor:
        """Undo `with_directions`; cosine and sine need not be of a unit vector."""
        others = len(self._not_headings)
        cos, sin = rows[:, others:].chunk(2, dim=1)
        angles = torch.empty(len(rows), self.width, dtype=rows.dtype, device=rows.device)
        angles[:, self._not_headings] = rows[:, :others]
        angles[:, self.headings] = torch.atan2(sin, cos)
        return angles

    @property
    def _not_headings(self) -> list[int]:
        return [column for column in range(self.width) if column not in self.headings]

    def believable(self, rows: np.ndarray) -> np.ndarray:
        """Return (N,) which rows a recording could hold: as `prepare`, so that the same is dropped on both sides.

        The command is within the robot's limits, the displacement within the believable one, and the pose not beyond
        the arena by more than half the vehicle.
        """
        row = self.split(rows)
        robot, margin_mm = self.robot, max(self.robot.vehicle_size_mm) / 2
        good = np.isfinite(rows).all(axis=1) & (np.abs(row.displacement) <= robot.displacement_limit).all(axis=1)
        good &= ((row.command >= robot.command_low) & (row.command <= robot.command_high)).all(axis=1)
        if not self.has_pose:
            return good
        position, arena = row.pose[:, :2], self.arena_mm
        inside = (position >= arena.low_mm - margin_mm) & (position <= arena.high_mm + margin_mm)
        return good & inside.all(axis=1) & (wrap_angle(row.pose[:, 2]) == row.pose[:, 2])


class Row(NamedTuple):
    """N rows taken apart: command (N, m), pose (N, 3), NaN where there is none, and displacement (N, 3)."""

    command: np.ndarray
    pose: np.ndarray
    displacement: np.ndarray
