"""The marker is turned on the vehicle."""

import math
from typing import ClassVar, Literal

import torch
from torch import Tensor

from swarmtwin.gap.mechanism import Mechanism, Quantity
from swarmtwin.gap.surroundings import Surroundings
from swarmtwin.robot import SituationPart


class Config(Mechanism):
    """The camera measures headings that are `angle_rad` more than the true ones."""

    words: ClassVar = "the marker is turned by {angle_rad} on the vehicle"
    remedy: ClassVar = "glue the marker on straight, or enter its angle"
    quantities: ClassVar = {"angle_rad": Quantity(-math.pi, math.pi, 0.0, "rad", (0.0,), 0.005)}
    needs: ClassVar[tuple[SituationPart, ...]] = ("pose",)

    name: Literal["marker_yaw"] = "marker_yaw"
    angle_rad: float

    def seen(self, pose: Tensor, surroundings: Surroundings) -> Tensor:
        """Turn."""
        return torch.cat([pose[:, :2], pose[:, 2:] + self.angle_rad], dim=-1)

    def true(self, pose: Tensor, surroundings: Surroundings) -> Tensor:
        """Turn back."""
        return torch.cat([pose[:, :2], pose[:, 2:] - self.angle_rad], dim=-1)
