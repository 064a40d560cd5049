"""The marker is turned on the vehicle."""

import math
from typing import ClassVar, Literal

import torch
from torch import Tensor

from swarmtwin.robot import SituationPart
from swarmtwin.simulation.conditions import SessionConditions
from swarmtwin.simulation.mechanism import Mechanism, Parameter


class Config(Mechanism):
    """The camera measures headings that are `angle_rad` more than the true ones."""

    stage: ClassVar = "marker"
    words: ClassVar = "the marker is turned by {angle_rad} {angle_rad:to the left/to the right} on the vehicle"
    remedy: ClassVar = "glue the marker on straight, or enter its angle"
    parameters: ClassVar = {"angle_rad": Parameter(-math.pi, math.pi, 0.0, "rad", (0.0,), 0.005)}
    inputs: ClassVar[tuple[SituationPart, ...]] = ("pose",)

    name: Literal["marker_yaw"] = "marker_yaw"
    angle_rad: float

    def to_measured(self, pose: Tensor, conditions: SessionConditions) -> Tensor:
        """Add the marker's angle to headings."""
        return torch.cat([pose[:, :2], pose[:, 2:] + self.angle_rad], dim=-1)

    def from_measured(self, pose: Tensor, conditions: SessionConditions) -> Tensor:
        """Take the marker's angle from headings."""
        return torch.cat([pose[:, :2], pose[:, 2:] - self.angle_rad], dim=-1)
