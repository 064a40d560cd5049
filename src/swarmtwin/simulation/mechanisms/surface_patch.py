"""Another grip in a region of the arena: dust or oil on the ground, weeds in the water."""

import math
from collections.abc import Mapping
from typing import ClassVar, Literal, NamedTuple

import numpy as np
import torch
from torch import Tensor

from swarmtwin.robot import Robot
from swarmtwin.simulation.conditions import SessionConditions
from swarmtwin.simulation.local_traction import LocalTraction
from swarmtwin.simulation.mechanism import Moment, Parameter
from swarmtwin.simulation.traction_score import LocalTractionScore

_STEPS = np.array([step for step in np.ndindex(3, 3, 3) if 0 < sum(one != 1 for one in step) < 3]) - 1.0


class _Disc(NamedTuple):
    """A patch of the loss that fits it best, as far as slopes tell.

    Attributes:
        place: (3,) x, y and radius in mm.
        loss: share of the way.
        nats: twice what it gains.
    """

    place: np.ndarray
    loss: float
    nats: float

    @classmethod
    def of(cls, places: np.ndarray, traction: LocalTractionScore, at_once: int = 500_000) -> list["_Disc"]:
        """Return those at places (n, 3); so many distances of transitions to them are held at once."""
        x_mm, y_mm = traction.position.T
        together = np.column_stack([traction.slope, traction.curvature])
        found = []
        for some in np.array_split(places, max(math.ceil(len(places) * len(x_mm) / at_once), 1)):
            inside = (x_mm - some[:, :1]) ** 2 + (y_mm - some[:, 1:2]) ** 2 < some[:, 2:] ** 2
            slope, curvature = (inside.astype(float) @ together).T
            curvature += 1e-9
            losses, nats = np.clip(slope / curvature, -0.5, 0.9), slope**2 / curvature
            found += [cls(*one) for one in zip(some, losses.tolist(), nats.tolist(), strict=True)]
        return found

    def moved(self, traction: LocalTractionScore, step_mm: float, ends: np.ndarray, least: float = 0.2) -> "_Disc":
        """Return the one that is reached by ever smaller steps uphill, within `ends` (2, 3).

        A step moves the disc or lets it grow, or both, so that the edge on one side stays where it is.
        """
        disc, size = self, 1.0
        while size >= least:
            places = np.clip(disc.place + size * step_mm * _STEPS, *ends)
            further = max(_Disc.of(places, traction), key=lambda one: one.nats)
            disc, size = (further, size) if further.nats > disc.nats else (disc, size / 2)
        return disc

    def values(self) -> dict[str, float]:
        """Return it as values of the mechanism's parameters."""
        x_mm, y_mm, radius_mm = map(float, self.place)
        return {"x_mm": x_mm, "y_mm": y_mm, "radius_mm": radius_mm, "loss": self.loss}


class Config(LocalTraction):
    """On a disc the actuators bring the vehicle less far by `loss`; negative where the grip is better.

    Attributes:
        x_mm: of its centre.
        y_mm: likewise.
        radius_mm: of it.
        loss: share of the way.
    """

    words: ClassVar = "around x {x_mm}, y {y_mm}, within {radius_mm}, vehicles lose {loss} of their {slows:way/drive}"
    remedy: ClassVar = "clean or level that place, or keep the robots off it"
    parameters: ClassVar = {}
    is_smooth: ClassVar = False

    name: Literal["surface_patch"] = "surface_patch"
    x_mm: float
    y_mm: float
    radius_mm: float
    loss: float

    @classmethod
    def parameters_of(cls, robot: Robot, conditions: SessionConditions) -> Mapping[str, Parameter]:
        """Look within the session's arena."""
        arena = conditions.arena_mm
        width, height = (float(size) for size in arena.high_mm - arena.low_mm)
        least = min(width, height)
        step_mm = 0.02 * least
        return {
            "x_mm": Parameter(
                arena.x[0], arena.x[1], None, "mm", (arena.x[0] + width / 2,), step_mm, doubted_ends="none"
            ),
            "y_mm": Parameter(
                arena.y[0], arena.y[1], None, "mm", (arena.y[0] + height / 2,), step_mm, doubted_ends="none"
            ),
            "radius_mm": Parameter(0.05 * least, 0.45 * least, None, "mm", (0.22 * least,), step_mm),
            "loss": Parameter(-0.6, 0.97, 0.0, "", (0.2,), 0.01, doubted_ends="low"),
        }

    @classmethod
    def initial_points(
        cls, robot: Robot, conditions: SessionConditions, traction: LocalTractionScore | None = None
    ) -> list[dict[str, float]]:
        """Lay discs of five sizes over a grid of the arena; move the three that explain most to where that is more."""
        low, high = conditions.arena_mm.low_mm, conditions.arena_mm.high_mm
        if traction is None:
            traction = LocalTractionScore(((low + high) / 2)[None], np.zeros(1), np.ones(1))
        least = float(min(high - low))
        x_mm, y_mm = (np.linspace(low[axis], high[axis], round(13 * (high - low)[axis] / least)) for axis in (0, 1))
        radii_mm = least * np.array([0.08, 0.14, 0.2, 0.27, 0.36])
        places = np.stack(np.meshgrid(radii_mm, y_mm, x_mm, indexing="ij")[::-1], axis=-1).reshape(-1, 3)
        discs = sorted(_Disc.of(places, traction), key=lambda disc: -disc.nats)
        ends = np.array([[low[0], low[1], 0.05 * least], [high[0], high[1], 0.45 * least]])
        moved = [disc.moved(traction, least / 26, ends) for disc in discs[:3]]
        return [disc.values() for disc in sorted(moved, key=lambda disc: -disc.nats)]

    def traction(self, position: Tensor, moment: Moment) -> Tensor:
        """Weaken the drive inside the disc; its edge is as soft as a fifth of a period's longest way is."""
        centre = torch.tensor([self.x_mm, self.y_mm], dtype=torch.float64)
        inside_mm = self.radius_mm - (position - centre).norm(dim=-1)
        soft_mm = 0.1 * moment.robot.largest_displacement.forward_mm
        return 1.0 - self.loss * (0.5 + inside_mm / soft_mm).clamp(0.0, 1.0)
