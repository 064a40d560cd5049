"""Where and how long a session took place: what mechanisms refer to beyond a single situation."""

from typing import Annotated

import torch
from pydantic import Field
from torch import Tensor

from swarmtwin.robot import Arena, Positive, StrictModel


class Surroundings(StrictModel):
    """What an extended simulation keeps of the session it was learned from.

    Attributes:
        arena_mm: walls, and through its middle and corners the camera's image.
        session_s: how long the session lasted; ageing counts on it.
        track_mm: distance between left and right wheel; null for robots without such.
        own_lag: how late the actuators follow by themselves, in periods; 0 where the simulation does not know.
    """

    arena_mm: Arena
    session_s: Positive
    track_mm: Annotated[float, Field(gt=0)] | None = None
    own_lag: Annotated[float, Field(ge=0, le=1)] = 0.0

    @property
    def centre_mm(self) -> Tensor:
        """The middle of the camera's image, (2,)."""
        return torch.as_tensor((self.arena_mm.low_mm + self.arena_mm.high_mm) / 2, dtype=torch.float64)

    @property
    def corner_mm(self) -> float:
        """From the middle of the image to a corner."""
        return float(torch.as_tensor(self.arena_mm.high_mm - self.arena_mm.low_mm).norm()) / 2

    def wall_distance_mm(self, position: Tensor) -> Tensor:
        """Return the distances (...) of positions (..., 2) from the nearest wall, 0 beyond it."""
        low, high = (torch.as_tensor(corner) for corner in (self.arena_mm.low_mm, self.arena_mm.high_mm))
        nearest = torch.minimum(position - low, high - position).amin(dim=-1)
        return nearest.clamp(min=0.0)

    def walls_seen(self, pose: Tensor, reach_mm: float) -> Tensor:
        """Return (N, 5) how near walls are and where they lie as seen from poses (N, 3).

        Each wall counts exp(−distance / reach), as a push away from it would; columns: all of them, their direction
        ahead and to the left, and the two second moments of the direction.
        """
        low, high = (torch.as_tensor(corner) for corner in (self.arena_mm.low_mm, self.arena_mm.high_mm))
        distance_mm = torch.cat([pose[:, :2] - low, high - pose[:, :2]], dim=-1).clamp(min=0.0)
        near = torch.exp(-distance_mm / reach_mm)
        cos, sin = pose[:, 2].cos(), pose[:, 2].sin()
        ahead = torch.stack([-cos, -sin, cos, sin], dim=-1)
        left = torch.stack([sin, -cos, -sin, cos], dim=-1)
        columns = [near, near * ahead, near * left, near * ahead**2, near * ahead * left]
        return torch.stack([column.sum(dim=-1) for column in columns], dim=-1)
