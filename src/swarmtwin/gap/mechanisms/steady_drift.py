"""A constant velocity in the arena's frame: a slope, a current."""

import math
from collections.abc import Mapping
from typing import ClassVar, Literal

import torch
from torch import Tensor

from swarmtwin.gap.mechanism import Drive, Mechanism, Quantity
from swarmtwin.robot import Robot, SituationPart


class Config(Mechanism):
    """Vehicles are carried along whatever they do, at `x_mm_s`, `y_mm_s`; told as a speed and a direction."""

    words: ClassVar = "vehicles drift at {speed_mm_s} towards {direction_rad}"
    remedy: ClassVar = "level the table, or look for the current"
    quantities: ClassVar = {}
    needs: ClassVar[tuple[SituationPart, ...]] = ("pose",)

    name: Literal["steady_drift"] = "steady_drift"
    x_mm_s: float
    y_mm_s: float

    @classmethod
    def quantities_of(cls, robot: Robot) -> Mapping[str, Quantity]:
        """Allow half of the largest believable speed."""
        high = 0.5 * robot.largest_displacement.forward_mm / robot.period_s
        return {name: Quantity(-high, high, 0.0, "mm/s", (0.0,), 0.01 * high) for name in ("x_mm_s", "y_mm_s")}

    def carried_mm_s(self, way: Tensor, drive: Drive) -> Tensor:
        """Add the drift."""
        return torch.tensor([[self.x_mm_s, self.y_mm_s]], dtype=torch.float64)

    def reported(self) -> dict[str, float]:
        """Tell speed and direction."""
        return {
            "speed_mm_s": math.hypot(self.x_mm_s, self.y_mm_s),
            "direction_rad": math.atan2(self.y_mm_s, self.x_mm_s),
        }

    @classmethod
    def units(cls, robot: Robot) -> dict[str, str]:
        """Return the units of what is told."""
        return {"speed_mm_s": "mm/s", "direction_rad": "rad"}
