"""Millimetres per pixel are wrong: the camera was moved or badly calibrated."""

from typing import ClassVar, Literal

import torch
from torch import Tensor

from swarmtwin.gap.mechanism import Mechanism, Quantity
from swarmtwin.gap.surroundings import Surroundings
from swarmtwin.robot import SituationPart


class Config(Mechanism):
    """Measured positions are `scale` times as far from the image's middle as true ones; headings are right."""

    words: ClassVar = "the camera measures distances {scale} times as long as they are"
    remedy: ClassVar = "calibrate the camera's millimetres per pixel anew"
    quantities: ClassVar = {"scale": Quantity(0.5, 2.0, 1.0, "", (1.0,), 0.005)}
    needs: ClassVar[tuple[SituationPart, ...]] = ("pose",)

    name: Literal["camera_scale"] = "camera_scale"
    scale: float

    def seen(self, pose: Tensor, surroundings: Surroundings) -> Tensor:
        """Stretch."""
        return _stretched(pose, surroundings.centre_mm, self.scale)

    def true(self, pose: Tensor, surroundings: Surroundings) -> Tensor:
        """Shrink."""
        return _stretched(pose, surroundings.centre_mm, 1 / self.scale)


def _stretched(pose: Tensor, centre_mm: Tensor, factor: float) -> Tensor:
    return torch.cat([centre_mm + (pose[:, :2] - centre_mm) * factor, pose[:, 2:]], dim=-1)
