"""The marker is off the centre of rotation."""

from collections.abc import Mapping
from typing import ClassVar, Literal

import torch
from torch import Tensor

from swarmtwin.geometry import rotate
from swarmtwin.robot import Robot, SituationPart
from swarmtwin.simulation.conditions import SessionConditions
from swarmtwin.simulation.mechanism import Mechanism, Parameter


class Config(Mechanism):
    """The camera sees a point that is `forward_mm`, `left_mm` off the one that the vehicle turns about."""

    stage: ClassVar = "marker"
    words: ClassVar = (
        "the marker sits {forward_mm} {forward_mm:ahead/behind} and {left_mm} {left_mm:to the left/to the right} of "
        "where it should"
    )
    remedy: ClassVar = "glue the marker over the centre of rotation, or enter its offset"
    parameters: ClassVar = {}
    inputs: ClassVar[tuple[SituationPart, ...]] = ("pose",)

    name: Literal["marker_offset"] = "marker_offset"
    forward_mm: float
    left_mm: float

    @classmethod
    def parameters_of(cls, robot: Robot, conditions: SessionConditions) -> Mapping[str, Parameter]:
        """Allow a vehicle's length."""
        high = max(robot.vehicle_size_mm)
        return {name: Parameter(-high, high, 0.0, "mm", (0.0,), 0.005 * high) for name in ("forward_mm", "left_mm")}

    def to_measured(self, pose: Tensor, conditions: SessionConditions) -> Tensor:
        """Return poses of the marker."""
        return self._moved(pose, 1.0)

    def from_measured(self, pose: Tensor, conditions: SessionConditions) -> Tensor:
        """Return poses of the centre of rotation."""
        return self._moved(pose, -1.0)

    def _moved(self, pose: Tensor, sign: float) -> Tensor:
        offset = torch.tensor([self.forward_mm, self.left_mm], dtype=torch.float64).expand(len(pose), 2)
        return torch.cat([pose[:, :2] + sign * rotate(offset, pose[:, 2]), pose[:, 2:]], dim=-1)
