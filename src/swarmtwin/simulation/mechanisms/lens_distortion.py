"""The scale changes with the distance from the image's centre."""

import math
from typing import ClassVar, Literal

import torch
from torch import Tensor

from swarmtwin.robot import SituationPart
from swarmtwin.simulation.conditions import SessionConditions
from swarmtwin.simulation.mechanism import Mechanism, Parameter


class Config(Mechanism):
    """Measured positions are moved radially: r · (1 + coefficient · r²), r = 1 at the arena's corners."""

    stage: ClassVar = "camera"
    words: ClassVar = "the lens stretches the image's corners (coefficient {coefficient})"
    remedy: ClassVar = "calibrate the lens and undistort the video"
    parameters: ClassVar = {"coefficient": Parameter(-0.3, 0.6, 0.0, "", (0.0,), 0.005)}
    inputs: ClassVar[tuple[SituationPart, ...]] = ("pose",)

    name: Literal["lens_distortion"] = "lens_distortion"
    coefficient: float

    def to_measured(self, pose: Tensor, conditions: SessionConditions) -> Tensor:
        """Move positions away from the centre."""
        away = (pose[:, :2] - conditions.centre_mm) / conditions.corner_mm
        factor = 1.0 + self.coefficient * (away**2).sum(dim=-1, keepdim=True)
        return torch.cat([conditions.centre_mm + away * factor * conditions.corner_mm, pose[:, 2:]], dim=-1)

    def from_measured(self, pose: Tensor, conditions: SessionConditions) -> Tensor:
        """Move positions back, by Newton's method; what no position is measured as, to the nearest that is."""
        away = (pose[:, :2] - conditions.centre_mm) / conditions.corner_mm
        measured = away.norm(dim=-1, keepdim=True)
        furthest = 1.0 / math.sqrt(3.0 * max(-self.coefficient, 1e-6))  # beyond it, measured positions come back
        radius = measured.clamp(max=furthest)
        for _ in range(20):  # enough for the strongest distortion that the bounds allow
            slope = (1.0 + 3.0 * self.coefficient * radius**2).clamp(min=0.05)
            missing = measured - radius * (1.0 + self.coefficient * radius**2)
            radius = (radius + missing / slope).clamp(max=furthest)
        true = conditions.centre_mm + away * (radius / measured.clamp(min=1e-12)) * conditions.corner_mm
        return torch.cat([true, pose[:, 2:]], dim=-1)
