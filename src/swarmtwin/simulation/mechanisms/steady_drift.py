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
    """Vehicles are carried along whatever they do, at `x_mm_s`, `y_mm_s`; reported as a speed and a direction.

    A current carries them that way. On a slope wheels that do not slip aside only roll that way: by the part of the
    velocity that lies along the heading.

    Attributes:
        x_mm_s: along the arena's x.
        y_mm_s: along its y.
        carries: the whole vehicle, or its wheels as far as they roll.
    """

    stage: ClassVar = "body"
    words: ClassVar = (
        "vehicles drift at {speed_mm_s} towards {direction_rad}{carries:/, as far as their wheels roll that way}"
    )
    remedy: ClassVar = "level the table, or look for the current"
    parameters: ClassVar = {}
    inputs: ClassVar[tuple[SituationPart, ...]] = ("pose",)

    name: Literal["steady_drift"] = "steady_drift"
    x_mm_s: float
    y_mm_s: float
    carries: Literal["vehicle", "wheels"] = "vehicle"

    @classmethod
    def forms(cls, robot: Robot) -> tuple[type[Mechanism], ...]:
        """Return that of whole vehicles, and for wheels that of these."""
        rolling = (Config.with_default("carries", "wheels"),) if robot.actuation.kind == "wheel" else ()
        return Config, *rolling

    @classmethod
    def parameters_of(cls, robot: Robot, conditions: SessionConditions) -> Mapping[str, Parameter]:
        """Allow half of the largest believable speed."""
        high = 0.5 * robot.largest_displacement.forward_mm / robot.period_s
        return {name: Parameter(-high, high, 0.0, "mm/s", (0.0,), 0.01 * high) for name in ("x_mm_s", "y_mm_s")}

    def drift_velocity(self, displacement: Tensor, moment: Moment) -> Tensor:
        """Add the drift, or its part along the heading in the middle of the period."""
        drift = torch.tensor([[self.x_mm_s, self.y_mm_s]], dtype=torch.float64)
        if self.carries == "vehicle":
            return drift
        heading = moment.pose[:, 2] + displacement[:, 2]
        ahead = torch.stack([heading.cos(), heading.sin()], dim=-1)
        return (drift * ahead).sum(dim=-1, keepdim=True) * ahead

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
