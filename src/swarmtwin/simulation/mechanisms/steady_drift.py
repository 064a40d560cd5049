"""A constant velocity in the arena's frame: a slope, a current."""

import math
from collections.abc import Mapping
from typing import ClassVar, Literal

import torch
from torch import Tensor

from swarmtwin.robot import Robot, SituationPart
from swarmtwin.simulation.conditions import SessionConditions
from swarmtwin.simulation.mechanism import Mechanism, Moment, Parameter


class Config(Mechanism):
    """Vehicles are carried along whatever they do, at `x_mm_s`, `y_mm_s`; reported as a speed and a direction."""

    stage: ClassVar = "body"
    words: ClassVar = "vehicles drift at {speed_mm_s} towards {direction_rad}"
    remedy: ClassVar = "level the table, or look for the current"
    parameters: ClassVar = {}
    inputs: ClassVar[tuple[SituationPart, ...]] = ("pose",)

    name: Literal["steady_drift"] = "steady_drift"
    x_mm_s: float
    y_mm_s: float

    @classmethod
    def parameters_of(cls, robot: Robot, conditions: SessionConditions) -> Mapping[str, Parameter]:
        """Allow half of the largest believable speed."""
        high = 0.5 * robot.largest_displacement.forward_mm / robot.period_s
        return {name: Parameter(-high, high, 0.0, "mm/s", (0.0,), 0.01 * high) for name in ("x_mm_s", "y_mm_s")}

    def drift_velocity(self, displacement: Tensor, moment: Moment) -> Tensor:
        """Add the drift."""
        return torch.tensor([[self.x_mm_s, self.y_mm_s]], dtype=torch.float64)

    def reported(self) -> dict[str, float]:
        """Return speed and direction."""
        return {
            "speed_mm_s": math.hypot(self.x_mm_s, self.y_mm_s),
            "direction_rad": math.atan2(self.y_mm_s, self.x_mm_s),
        }

    @classmethod
    def units(cls, robot: Robot, conditions: SessionConditions) -> dict[str, str]:
        """Return the units of what is told."""
        return {"speed_mm_s": "mm/s", "direction_rad": "rad"}
