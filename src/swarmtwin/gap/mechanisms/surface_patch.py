"""Another grip in a region of the arena: dust or oil on the ground, weeds in the water."""

from collections.abc import Mapping
from typing import ClassVar, Literal

import numpy as np
import torch
from torch import Tensor

from swarmtwin.gap.mechanism import Drive, Mechanism, Places, Quantity
from swarmtwin.gap.surroundings import Surroundings
from swarmtwin.robot import Robot, SituationPart

CELLS = 13
RADII = (0.08, 0.14, 0.2, 0.27, 0.36)
KEPT = 3


class Config(Mechanism):
    """On a disc the actuators bring the vehicle less far by `loss`; negative where the grip is better."""

    words: ClassVar = "around x {x_mm}, y {y_mm}, within {radius_mm}, vehicles lose {loss} of their way"
    remedy: ClassVar = "clean or level that place, or keep the robots off it"
    quantities: ClassVar = {}
    needs: ClassVar[tuple[SituationPart, ...]] = ("pose",)
    is_smooth: ClassVar = False
    widening: ClassVar = 2.2

    name: Literal["surface_patch"] = "surface_patch"
    x_mm: float
    y_mm: float
    radius_mm: float
    loss: float

    @classmethod
    def quantities_of(cls, robot: Robot) -> Mapping[str, Quantity]:
        """Look within the usual arena and a little beyond."""
        arena = robot.arena_mm
        width, height = (float(size) for size in arena.high_mm - arena.low_mm)
        least = min(width, height)
        return {
            "x_mm": Quantity(arena.x[0], arena.x[1], None, "mm", (arena.x[0] + width / 2,), 0.02 * least),
            "y_mm": Quantity(arena.y[0], arena.y[1], None, "mm", (arena.y[0] + height / 2,), 0.02 * least),
            "radius_mm": Quantity(0.05 * least, 0.45 * least, None, "mm", (0.22 * least,), 0.02 * least),
            "loss": Quantity(-0.6, 0.97, 0.0, "", (0.2,), 0.01),
        }

    @classmethod
    def starts(cls, robot: Robot, surroundings: Surroundings, places: Places | None = None) -> list[dict[str, float]]:
        """Lay discs of several sizes over the arena and keep those that would explain most."""
        low, high = surroundings.arena_mm.low_mm, surroundings.arena_mm.high_mm
        if places is None:
            places = Places(((low + high) / 2)[None], np.zeros(1), np.ones(1))
        least = float(min(high - low))
        x_mm, y_mm = (np.linspace(low[axis], high[axis], round(CELLS * (high - low)[axis] / least)) for axis in (0, 1))
        found = []
        for radius in RADII:
            for centre in np.stack(np.meshgrid(x_mm, y_mm), axis=-1).reshape(-1, 2):
                inside = ((places.position - centre) ** 2).sum(axis=1) < (radius * least) ** 2
                slope, curvature = places.slope[inside].sum(), places.curvature[inside].sum() + 1e-9
                loss = float(np.clip(slope / curvature, -0.5, 0.9))
                disc = {"x_mm": float(centre[0]), "y_mm": float(centre[1]), "radius_mm": radius * least, "loss": loss}
                found.append((slope**2 / curvature, disc))
        found.sort(key=lambda entry: -entry[0])
        return [disc for _, disc in found[:KEPT]]

    def grip(self, position: Tensor, drive: Drive) -> Tensor:
        """Weaken the drive inside the disc; its edge is as soft as the path is coarse."""
        centre = torch.tensor([self.x_mm, self.y_mm], dtype=torch.float64)
        inside_mm = self.radius_mm - (position - centre).norm(dim=-1)
        soft_mm = 0.1 * drive.robot.largest_displacement.forward_mm
        return 1.0 - self.loss * (0.5 + inside_mm / soft_mm).clamp(0.0, 1.0)
