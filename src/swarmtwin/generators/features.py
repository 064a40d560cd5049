"""A situation as a network sees it best: the command by its limits, the place weakly, the walls from the vehicle."""

import math

import torch
from torch import Tensor, nn

from swarmtwin.generators.columns import Columns

WALLS = 4
WALL_COLUMNS = 5
PLACE_COLUMNS = 4


class SituationFeatures(nn.Module):
    """Rows' situations (N, situation_width) → features (N, width).

    Motion that depends on the pose mostly depends on the walls, and those act in the vehicle's frame: a wall ahead does
    the same in every corner of the arena. So each wall at distance d weighs exp(−d / reach), and the weights enter
    alone, and with cosine and sine of the angle at which the vehicle sees the wall, and of twice that angle. The place
    itself (position, cosine and sine of heading) enters scaled down, for what depends on the place and not on walls.
    """

    def __init__(self, columns: Columns, wall_reach_lengths: float, place_weight: float) -> None:
        """Build for a robot's columns; `wall_reach_lengths` in lengths of the vehicle."""
        super().__init__()
        robot = columns.robot
        self.commands = len(robot.command)
        self.has_pose = columns.has_pose
        self.width = self.commands + (PLACE_COLUMNS + WALL_COLUMNS if self.has_pose else 0)
        self.reach_mm = wall_reach_lengths * robot.vehicle_size_mm[0]
        self.place_weight = place_weight
        constants = {"low": robot.command_low, "high": robot.command_high}
        constants |= {"arena_low_mm": robot.arena_mm.low_mm, "arena_high_mm": robot.arena_mm.high_mm}
        for name, value in constants.items():
            self.register_buffer(name, torch.as_tensor(value, dtype=torch.float32), persistent=False)

    low: Tensor
    high: Tensor
    arena_low_mm: Tensor
    arena_high_mm: Tensor

    def forward(self, situation: Tensor) -> Tensor:
        """Return the features."""
        command = 2 * (situation[:, : self.commands] - self.low) / (self.high - self.low) - 1
        if not self.has_pose:
            return command
        position_mm, heading = situation[:, -3:-1], situation[:, -1:]
        place = 2 * (position_mm - self.arena_low_mm) / (self.arena_high_mm - self.arena_low_mm) - 1
        place = self.place_weight * torch.cat([place, heading.cos(), heading.sin()], dim=1)
        return torch.cat([command, place, self._walls(position_mm, heading)], dim=1)

    def _walls(self, position_mm: Tensor, heading: Tensor) -> Tensor:
        """Return (N, 5) what the vehicle sees of the walls."""
        distance_mm = torch.cat([self.arena_high_mm - position_mm, position_mm - self.arena_low_mm], dim=1)
        weight = torch.exp(-distance_mm.clamp(min=0) / self.reach_mm)
        direction = torch.arange(WALLS, device=heading.device) * (
            math.pi / 2
        )  # of the walls at high x, high y, low x, low y
        seen_at = direction - heading
        waves = [torch.ones_like(seen_at), seen_at.cos(), seen_at.sin(), (2 * seen_at).cos(), (2 * seen_at).sin()]
        return torch.stack([(weight * wave).sum(dim=1) for wave in waves], dim=1)
