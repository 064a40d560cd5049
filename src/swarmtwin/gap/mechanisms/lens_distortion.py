"""The scale changes with the distance from the image's centre."""

from typing import ClassVar, Literal

import torch
from torch import Tensor

from swarmtwin.gap.mechanism import Mechanism, Quantity
from swarmtwin.gap.surroundings import Surroundings
from swarmtwin.robot import SituationPart

ITERATIONS = 12


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
        """Move back, by fixed-point iteration."""
        away = (pose[:, :2] - surroundings.centre_mm) / surroundings.corner_mm
        found = away
        for _ in range(ITERATIONS):
            found = away / (1.0 + self.coefficient * (found**2).sum(dim=-1, keepdim=True)).clamp(min=0.2)
        return torch.cat([surroundings.centre_mm + found * surroundings.corner_mm, pose[:, 2:]], dim=-1)
