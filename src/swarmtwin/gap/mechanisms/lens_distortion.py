"""The scale changes with the distance from the image's centre."""

from typing import ClassVar, Literal

import torch
from torch import Tensor

from swarmtwin.gap.mechanism import Mechanism, Quantity
from swarmtwin.gap.surroundings import Surroundings
from swarmtwin.robot import SituationPart

ITERATIONS = 20


class Config(Mechanism):
    """Measured positions are moved radially: r · (1 + coefficient · r²), r = 1 at the arena's corners."""

    words: ClassVar = "the lens stretches the image's corners (coefficient {coefficient})"
    remedy: ClassVar = "calibrate the lens and undistort the video"
    quantities: ClassVar = {"coefficient": Quantity(-0.3, 0.6, 0.0, "", (0.0,), 0.005)}
    needs: ClassVar[tuple[SituationPart, ...]] = ("pose",)

    name: Literal["lens_distortion"] = "lens_distortion"
    coefficient: float

    def seen(self, pose: Tensor, surroundings: Surroundings) -> Tensor:
        """Move outwards."""
        away = (pose[:, :2] - surroundings.centre_mm) / surroundings.corner_mm
        factor = 1.0 + self.coefficient * (away**2).sum(dim=-1, keepdim=True)
        return torch.cat([surroundings.centre_mm + away * factor * surroundings.corner_mm, pose[:, 2:]], dim=-1)

    def true(self, pose: Tensor, surroundings: Surroundings) -> Tensor:
        """Move back, by Newton's method."""
        away = (pose[:, :2] - surroundings.centre_mm) / surroundings.corner_mm
        measured = away.norm(dim=-1, keepdim=True)
        radius = measured
        for _ in range(ITERATIONS):
            slope = (1.0 + 3.0 * self.coefficient * radius**2).clamp(min=0.05)
            radius = radius - (radius * (1.0 + self.coefficient * radius**2) - measured) / slope
        true = surroundings.centre_mm + away * (radius / measured.clamp(min=1e-12)) * surroundings.corner_mm
        return torch.cat([true, pose[:, 2:]], dim=-1)
