"""Situations become columns of numbers, the columns network inputs, and network outputs displacements again.

One encoding serves every learner. What it is made of, the caller says as a list of features, in order:

    Encoding.for_network(robot, inputs, "unit_range")                         dynamics models: scaling learned from data
    Encoding(robot, ("command", "previous_command", "walls"), "limits", wall_reaches_mm=(60.0,))
    Encoding(robot, ("command", "direction", "position", "elapsed_s"), "limits", arena_mm=arena, session_s=600.0)

With `limits` nothing is learned and no weights are kept: commands are scaled by the robot's limits, positions by the
arena, velocities by the largest believable ones, times by the session and the period.
"""

from collections.abc import Mapping, Sequence
from typing import Literal, get_args

import numpy as np
import torch
from torch import Tensor, nn

from swarmtwin.compilable import can_pass_over
from swarmtwin.errors import UserError
from swarmtwin.learning.situation import Situation
from swarmtwin.robot import Arena, Robot, SituationPart

Feature = Literal[
    "command",
    "previous_command",
    "earlier_command",
    "position",
    "heading",
    "direction",
    "walls",
    "velocity",
    "elapsed_s",
    "duration_s",
    "neighbours",
]
"""What can be made of a situation; the columns of each:

- `command`, `previous_command`, `earlier_command`: (m) in the robot's units; where there was none before, the usual one
  of the training data stands in, and rest with `limits`;
- `position`: x_mm, y_mm; `heading`: one angle in rad, which jumps at ±π; `direction`: its cosine and sine;
- `walls`: for each reach, five columns: the walls of the arena, each weighing exp(−distance / reach): their sum, their
  direction ahead and to the left of the vehicle, and the two second moments of that direction;
- `velocity`: forward_mm_s, left_mm_s, turn_rad_s; where it is not known, the usual one of the training data, and rest
  with `limits`;
- `elapsed_s`, `duration_s`;
- `neighbours`: the sum over neighbours of the unit vector to each, ahead and to the left, weighing
  exp(−distance / reach). A set of any size, in any order, gives two columns.
"""

_PART_OF: dict[Feature, SituationPart] = {
    "command": "command",
    "previous_command": "previous_command",
    "earlier_command": "earlier_command",
    "position": "pose",
    "heading": "pose",
    "direction": "pose",
    "walls": "pose",
    "velocity": "velocity",
    "elapsed_s": "elapsed_s",
    "duration_s": "duration_s",
    "neighbours": "neighbours",
}

ScalingMethod = Literal["unit_range", "standard", "physical", "limits"]


class Scaling(nn.Module):
    """An affine map per column, `(values − offset) / scale`, kept with the weights where it is learned.

    `unit_range` maps the columns' observed range to 0…1 (the published networks), `standard` to mean 0 and standard
    deviation 1, `physical` leaves the units as they are, `limits` takes offset and scale as they are given. A column
    that does not vary keeps scale 1.
    """

    offset: Tensor
    scale: Tensor

    def __init__(
        self, columns: int, method: ScalingMethod, offset: Tensor | None = None, scale: Tensor | None = None
    ) -> None:
        super().__init__()
        self.method = method
        learned = method != "limits"
        self.register_buffer("offset", torch.zeros(columns) if offset is None else offset, persistent=learned)
        self.register_buffer("scale", torch.ones(columns) if scale is None else scale, persistent=learned)

    def learn(self, values: Tensor) -> None:
        """Take offset and scale from `values` (N, columns), without NaN."""
        if self.method in ("physical", "limits"):
            return
        if self.method == "unit_range":
            low, high = values.min(dim=0).values, values.max(dim=0).values
            offset, scale = low, high - low
        else:
            offset, scale = values.mean(dim=0), values.std(dim=0, correction=0)
        varies = scale > 1e-6 * offset.abs().clamp(min=1e-3)
        self.offset.copy_(offset)
        self.scale.copy_(torch.where(varies, scale, torch.ones_like(scale)))

    def forward(self, values: Tensor) -> Tensor:
        """Scale values (..., columns)."""
        return (values - self.offset) / self.scale

    def inverse(self, scaled: Tensor) -> Tensor:
        """Undo `forward`."""
        return scaled * self.scale + self.offset


class Encoding(nn.Module):
    """The features of a situation side by side as columns, scaled: (N, width), float32.

    Attributes:
        features: what it is made of, in the order of the columns.
        inputs: the parts of a situation that it looks at.
        width: how many columns there are.
    """

    usual_previous_command: Tensor
    usual_earlier_command: Tensor
    usual_velocity: Tensor
    walls_mm: Tensor

    def __init__(
        self,
        robot: Robot,
        features: Sequence[Feature],
        scaling: ScalingMethod,
        *,
        arena_mm: Arena | None = None,
        session_s: float | None = None,
        wall_reaches_mm: Sequence[float] = (),
        neighbour_reach_mm: float | None = None,
        weights: Mapping[Feature, float] | None = None,
    ) -> None:
        """Put an encoding together.

        Args:
            robot: gives the limits of commands and the period.
            features: what it is made of.
            scaling: how columns are scaled.
            arena_mm: for `walls` and, with `limits`, `position`; None: the robot's usual arena, and where the walls
                are is learned and kept with the weights.
            session_s: how long a session lasts: `elapsed_s` beyond it counts as its end; with `limits` it is needed.
            wall_reaches_mm: the distances over which walls are seen to fade, for `walls`.
            neighbour_reach_mm: the same for `neighbours`; None: two lengths of the vehicle.
            weights: factors of scaled columns, with `limits`: what weighs less is learned later.
        """
        super().__init__()
        self.robot = robot
        self.features = tuple(features)
        self.arena_mm = arena_mm or robot.arena_mm
        self.session_s = session_s
        self.wall_reaches_mm = tuple(wall_reaches_mm)
        self.neighbour_reach_mm = neighbour_reach_mm or 2 * max(robot.vehicle_size_mm)
        asked = {_PART_OF[feature] for feature in features}
        self.inputs: tuple[SituationPart, ...] = tuple(part for part in get_args(SituationPart) if part in asked)
        self.width = sum(self.width_of(feature) for feature in features)
        low, high = torch.as_tensor(robot.command_low), torch.as_tensor(robot.command_high)
        if scaling == "limits":
            self.scaling = Scaling(self.width, scaling, *self._limits(weights or {}))
            usual = torch.zeros_like(low).clamp(low, high)
        else:
            self.scaling = Scaling(self.width, scaling)
            usual = torch.zeros(len(low))
        if "walls" in features:
            corners = np.array([self.arena_mm.low_mm, self.arena_mm.high_mm])
            self.register_buffer("walls_mm", torch.as_tensor(corners, dtype=torch.float32), persistent=arena_mm is None)
        learned = scaling != "limits"
        self.register_buffer("usual_previous_command", usual, persistent=learned)
        if "earlier_command" in features:  # weights saved before there was this feature have no such buffer
            self.register_buffer("usual_earlier_command", usual.clone(), persistent=learned)
        if "velocity" in features:
            self.register_buffer("usual_velocity", torch.zeros(3), persistent=learned)

    @classmethod
    def for_network(
        cls, robot: Robot, inputs: Sequence[SituationPart], scaling: ScalingMethod, wall_reaches: Sequence[float] = ()
    ) -> "Encoding":
        """Encode parts of a situation as the authors' code orders them, which matters to networks that read a sequence.

        A heading is one column with `unit_range`, as in the paper, and its cosine and sine otherwise. The walls follow
        the pose where there are `wall_reaches`, shares of the arena's shorter side; in the paper there are none.
        """
        walls: tuple[Feature, ...] = ("walls",) if wall_reaches else ()
        heading: Feature = "heading" if scaling == "unit_range" else "direction"
        order: tuple[tuple[SituationPart, tuple[Feature, ...]], ...] = (
            ("pose", ("position", heading, *walls)),
            ("command", ("command",)),
            ("previous_command", ("previous_command",)),
            ("earlier_command", ("earlier_command",)),
            ("velocity", ("velocity",)),
            ("elapsed_s", ("elapsed_s",)),
            ("duration_s", ("duration_s",)),
            ("neighbours", ("neighbours",)),
        )
        features = [feature for part, own in order if part in inputs for feature in own]
        return cls(robot, features, scaling, wall_reaches_mm=_in_mm(wall_reaches, robot.arena_mm))

    @classmethod
    def by_limits(
        cls,
        robot: Robot,
        inputs: Sequence[SituationPart],
        wall_reaches: Sequence[float],
        place_weight: float,
        arena_mm: Arena | None = None,
    ) -> "Encoding":
        """Encode command, pose and velocity by limits, the pose mainly by the walls: what few data suffice for.

        Motion that depends on the pose mostly depends on the walls, and those act in the vehicle's frame: a wall ahead
        does the same in every corner of the arena. How far they act nobody knows beforehand, so their reaches are a
        ladder over the arena.

        Args:
            robot: whose situations.
            inputs: the parts to encode.
            wall_reaches: shares of the arena's shorter side.
            place_weight: of position and heading themselves.
            arena_mm: None: the robot's usual arena, until another is learned.
        """
        parts: dict[SituationPart, tuple[Feature, ...]] = {
            "command": ("command",),
            "previous_command": ("previous_command",),
            "pose": ("position", "direction", *(("walls",) if wall_reaches else ())),
            "velocity": ("velocity",),
        }
        if unknown := [part for part in inputs if part not in parts]:
            raise UserError(
                f"this model looks at command, pose and velocity, not at {unknown[0]}: take it out of its situation"
            )
        return cls(
            robot,
            [feature for part in parts if part in inputs for feature in parts[part]],
            "limits",
            arena_mm=arena_mm,
            wall_reaches_mm=_in_mm(wall_reaches, arena_mm or robot.arena_mm),
            weights={"position": place_weight, "direction": place_weight},
        )

    def width_of(self, feature: Feature) -> int:
        """Return how many columns a feature has."""
        commands = len(self.robot.command)
        several = {
            "command": commands,
            "previous_command": commands,
            "earlier_command": commands,
            "position": 2,
            "direction": 2,
            "walls": 5 * len(self.wall_reaches_mm),
            "velocity": 3,
            "neighbours": 2,
        }
        return several.get(feature, 1)

    def columns_of(self, feature: Feature) -> list[int]:
        """Return the numbers of a feature's columns; none where it is not encoded."""
        if feature not in self.features:
            return []
        before = self.features[: self.features.index(feature)]
        start = sum(self.width_of(earlier) for earlier in before)
        return list(range(start, start + self.width_of(feature)))

    def learn(self, situation: Situation, arena_mm: Arena | None = None) -> None:
        """Take scaling and usual commands from training situations; with `limits` and `physical` nothing is scaled.

        Where the walls are is taken from `arena_mm`, that of the situations; None: the one that is known already.
        """
        if arena_mm and "walls" in self.features:
            self.walls_mm.copy_(torch.as_tensor(np.array([arena_mm.low_mm, arena_mm.high_mm])))
        if self.scaling.method != "limits":
            if situation.previous_command is not None:
                self.usual_previous_command.copy_(situation.previous_command.nanmean(dim=0).nan_to_num())
            if "earlier_command" in self.features and situation.earlier_command is not None:
                self.usual_earlier_command.copy_(situation.earlier_command.nanmean(dim=0).nan_to_num())
            if "velocity" in self.features and situation.velocity is not None:
                self.usual_velocity.copy_(situation.velocity.nanmean(dim=0).nan_to_num())
        self.scaling.learn(self._columns(situation))

    def forward(self, situation: Situation) -> Tensor:
        """Return the columns (N, width) of N situations that hold `inputs`; gradients flow to poses and commands."""
        scaled: Tensor = self.scaling(self._columns(situation))
        return scaled.float()

    def _columns(self, situation: Situation) -> Tensor:
        situation = situation.only({"command", *self.inputs})
        return torch.cat([self._unscaled(feature, situation) for feature in self.features], dim=-1)

    def _unscaled(self, feature: Feature, situation: Situation) -> Tensor:
        part = getattr(situation, _PART_OF[feature])
        match feature:
            case "previous_command":
                return torch.where(part.isnan(), self.usual_previous_command, part)
            case "earlier_command":
                return torch.where(part.isnan(), self.usual_earlier_command, part)
            case "velocity":
                return torch.where(part.isnan(), self.usual_velocity, part)
            case "position":
                return part[:, :2]
            case "heading":
                return part[:, 2:]
            case "direction":
                return torch.cat([part[:, 2:].cos(), part[:, 2:].sin()], dim=-1)
            case "walls":
                return self._walls(part)
            case "neighbours":
                return self._neighbours(part[..., :2])
            case "elapsed_s" if self.session_s is not None:
                return part[:, None].clamp(0.0, self.session_s)
            case "elapsed_s" | "duration_s":
                return part[:, None]
            case _:
                return part

    def _walls(self, pose: Tensor) -> Tensor:
        """Return how near walls are and where they lie as seen from poses (N, 3), five columns a reach."""
        low, high = self.walls_mm.to(pose)
        if can_pass_over(pose):
            from swarmtwin.learning import compiled_walls

            given = (one.contiguous().numpy() for one in (pose, low, high))
            return torch.from_numpy(compiled_walls.near_walls(*given, np.array(self.wall_reaches_mm)))
        distance_mm = torch.cat([pose[:, :2] - low, high - pose[:, :2]], dim=-1).clamp(min=0.0)
        cos, sin = pose[:, 2].cos(), pose[:, 2].sin()
        ahead = torch.stack([-cos, -sin, cos, sin], dim=-1)
        left = torch.stack([sin, -cos, -sin, cos], dim=-1)
        columns: list[Tensor] = []
        for reach_mm in self.wall_reaches_mm:
            near = torch.exp(-distance_mm / reach_mm)
            columns += [near, near * ahead, near * left, near * ahead**2, near * ahead * left]
        return torch.stack([column.sum(dim=-1) for column in columns], dim=-1)

    def _neighbours(self, away_mm: Tensor) -> Tensor:
        """Return (N, 2) from where neighbours at (N, K, 2) push; a neighbour of NaN is none."""
        distance_mm = away_mm.norm(dim=-1, keepdim=True)
        near = torch.exp(-distance_mm / self.neighbour_reach_mm)
        return (near * away_mm / distance_mm.clamp(min=1.0)).nan_to_num(0.0).sum(dim=1)

    def _limits(self, weights: Mapping[Feature, float]) -> tuple[Tensor, Tensor]:
        """Return offset and scale (width,), float64, by which what is usual comes to about −1…1."""
        offsets, scales = [], []
        for feature in self.features:
            middle, half = (np.broadcast_to(value, self.width_of(feature)) for value in self._limits_of(feature))
            offsets.append(middle)
            scales.append(half / weights.get(feature, 1.0))
        return torch.as_tensor(np.concatenate(offsets)), torch.as_tensor(np.concatenate(scales))

    def _limits_of(self, feature: Feature) -> tuple[np.ndarray | float, np.ndarray | float]:
        """Return the middle and the half range of a feature's columns."""
        robot, arena = self.robot, self.arena_mm
        match feature:
            case "command" | "previous_command" | "earlier_command":
                return (robot.command_low + robot.command_high) / 2, (robot.command_high - robot.command_low) / 2
            case "position":
                return (arena.low_mm + arena.high_mm) / 2, (arena.high_mm - arena.low_mm) / 2
            case "velocity":
                return 0.0, robot.displacement_limit / robot.period_s
            case "elapsed_s":
                assert self.session_s is not None, "elapsed_s by limits needs session_s"
                return self.session_s / 2, self.session_s / 2
            case "duration_s":  # periods differ by some tenths at most
                return robot.period_s, robot.period_s / 10
            case _:
                return 0.0, 1.0


def _in_mm(shares: Sequence[float], arena_mm: Arena) -> list[float]:
    """Return shares of the arena's shorter side as lengths."""
    shorter_side_mm = float((arena_mm.high_mm - arena_mm.low_mm).min())
    return [share * shorter_side_mm for share in shares]
