"""Millimetres per pixel are wrong: the camera was moved or badly calibrated."""

from typing import ClassVar, Literal

import torch
from torch import Tensor

from swarmtwin.robot import SituationPart
from swarmtwin.simulation.conditions import SessionConditions
from swarmtwin.simulation.mechanism import Mechanism, Parameter


class Config(Mechanism):
    """Measured positions are `scale` times as far from the image's middle as true ones; headings are right.

    It acts after the lens: what that has bent is counted in wrong millimetres per pixel.
    """

    stage: ClassVar = "camera"
    words: ClassVar = "the camera measures distances {scale} times as long as they are"
    remedy: ClassVar = "calibrate the camera's millimetres per pixel anew"
    parameters: ClassVar = {"scale": Parameter(0.5, 2.0, 1.0, "", (1.0,), 0.005)}
    inputs: ClassVar[tuple[SituationPart, ...]] = ("pose",)
    place_in_stage: ClassVar = 1

    name: Literal["camera_scale"] = "camera_scale"
    scale: float

    def to_measured(self, pose: Tensor, conditions: SessionConditions) -> Tensor:
        """Stretch positions about the image's centre."""
        return _stretched(pose, conditions.centre_mm, self.scale)

    def from_measured(self, pose: Tensor, conditions: SessionConditions) -> Tensor:
        """Shrink positions towards the image's centre."""
        return _stretched(pose, conditions.centre_mm, 1 / self.scale)


def _stretched(pose: Tensor, centre_mm: Tensor, factor: float) -> Tensor:
    return torch.cat([centre_mm + (pose[:, :2] - centre_mm) * factor, pose[:, 2:]], dim=-1)
