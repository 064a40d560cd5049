"""Millimetres per pixel are wrong: the camera was moved or badly calibrated."""

import math
from collections.abc import Mapping
from typing import ClassVar, Literal

import torch
from torch import Tensor

from swarmtwin.geometry import wrap_angle
from swarmtwin.robot import Robot, SituationPart
from swarmtwin.simulation.conditions import SessionConditions
from swarmtwin.simulation.mechanism import Mechanism, Parameter


class Config(Mechanism):
    """Measured positions are `scale` times as far from the image's middle as true ones; headings are right.

    Or along x by another factor than along y, as where the width and the height of an arena were measured, one of them
    badly: headings are then those of what is stretched. It acts after the lens: what that has bent is counted in wrong
    millimetres per pixel.

    Attributes:
        scale: the factor; the geometric mean of both.
        axes: whether both are the same.
        ratio: of that along y to that along x; None: 1.
    """

    stage: ClassVar = "camera"
    words: ClassVar = (
        "the camera measures distances {scale} times as long as they are{axes:/, and along y }{ratio}{axes:/ times as "
        "long as along x}"
    )
    remedy: ClassVar = "calibrate the camera's millimetres per pixel anew"
    parameters: ClassVar = {
        "scale": Parameter(0.5, 2.0, 1.0, "", (1.0,), 0.005),
        "ratio": Parameter(0.5, 2.0, 1.0, "", (1.0,), 0.005),
    }
    inputs: ClassVar[tuple[SituationPart, ...]] = ("pose",)
    place_in_stage: ClassVar = 1

    name: Literal["camera_scale"] = "camera_scale"
    scale: float
    axes: Literal["alike", "apart"] = "alike"
    ratio: float | None = None

    @classmethod
    def forms(cls, robot: Robot) -> tuple[type[Mechanism], ...]:
        """Return that of one factor and that of two."""
        return Config, Config.with_default("axes", "apart")

    @classmethod
    def parameters_of(cls, robot: Robot, conditions: SessionConditions) -> Mapping[str, Parameter]:
        """Return the ratio where there are two factors alone."""
        is_one = cls.usual_form()["axes"] == "alike"
        return {name: one for name, one in cls.parameters.items() if name != "ratio" or not is_one}

    @classmethod
    def bounds_of(cls, robot: Robot, conditions: SessionConditions) -> Mapping[str, Parameter]:
        """Return both."""
        return cls.parameters

    def to_measured(self, pose: Tensor, conditions: SessionConditions) -> Tensor:
        """Stretch positions about the image's centre."""
        along_x, along_y = self._factors()
        return _stretched(pose, conditions.centre_mm, along_x, along_y)

    def from_measured(self, pose: Tensor, conditions: SessionConditions) -> Tensor:
        """Shrink positions towards the image's centre."""
        along_x, along_y = self._factors()
        return _stretched(pose, conditions.centre_mm, 1 / along_x, 1 / along_y)

    def _factors(self) -> tuple[float, float]:
        root = math.sqrt(self.ratio or 1.0)
        return self.scale / root, self.scale * root


def _stretched(pose: Tensor, centre_mm: Tensor, along_x: float, along_y: float) -> Tensor:
    factors = torch.tensor([along_x, along_y], dtype=pose.dtype)
    position, heading = centre_mm + (pose[:, :2] - centre_mm) * factors, pose[:, 2:]
    if along_x != along_y:
        turned = torch.atan2(along_y * heading.sin(), along_x * heading.cos())
        heading = heading + wrap_angle(turned - heading)
    return torch.cat([position, heading], dim=-1)
