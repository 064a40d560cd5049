"""Where and how long a session took place, and what its robot's motion shows of its actuators."""

from typing import Annotated, Any

import torch
from pydantic import Field, model_validator
from torch import Tensor

from swarmtwin.robot import Arena, Positive, StrictModel

Exponent = Annotated[float, Field(gt=0)]
Lag = Annotated[float, Field(ge=0, le=1)]


class SessionConditions(StrictModel):
    """What mechanisms refer to beyond the moment: kept with the simulation that they extend.

    Attributes:
        arena_mm: the walls; the camera's image is taken to have the same centre and corners.
        session_s: how long the session lasted; a battery ages over it.
        track_mm: distance between left and right wheel; null for robots without such.
        own_lags: time constants, in control periods, with which the motion (forward, left, turn) follows by itself; 0
            where the dynamics model does not look at the previous command.
        gear_friction_mm_s: by which speed wheels are slower for friction in their gears: as those show it that stop or
            turn back. 0 where none is seen.
        effort_exponents: of thrust, the power of the actuators' effort with which motion (forward, left, turn) grows,
            as the dynamics model shows it; 1 for wheels.
        clearance_mm: how near vehicles come to walls that they face, and to walls that they lie along; null where
            nothing stops them.
    """

    arena_mm: Arena
    session_s: Positive
    track_mm: Annotated[float, Field(gt=0)] | None = None
    own_lags: tuple[Lag, Lag, Lag] = (0.0, 0.0, 0.0)
    gear_friction_mm_s: Annotated[float, Field(ge=0)] = 0.0
    effort_exponents: tuple[Exponent, Exponent, Exponent] = (1.0, 1.0, 1.0)
    clearance_mm: tuple[float, float] | None = None

    @model_validator(mode="before")
    @classmethod
    def _of_earlier_versions(cls, content: Any) -> Any:
        """Read what had one lag for all axes."""
        if isinstance(content, dict) and "own_lag" in content:
            content = {**content, "own_lags": (content["own_lag"],) * 3}
            del content["own_lag"]
        return content

    @property
    def centre_mm(self) -> Tensor:
        """The centre of the camera's image, (2,)."""
        return torch.as_tensor((self.arena_mm.low_mm + self.arena_mm.high_mm) / 2, dtype=torch.float64)

    @property
    def corner_mm(self) -> float:
        """Distance from the image's centre to a corner."""
        return float(torch.as_tensor(self.arena_mm.high_mm - self.arena_mm.low_mm).norm()) / 2

    def progress(self, elapsed_s: Tensor) -> Tensor:
        """Return the share of the session that has passed at times (...), in [0, 1]."""
        return (elapsed_s / self.session_s).clamp(0.0, 1.0)

    def stopped_mm(self, pose: Tensor, carried: Tensor, held_back: Tensor) -> Tensor:
        """Return how far vehicles that came to poses (N, 3) are carried, (N, 2), of the way `carried` (N, 2).

        Walls stop an elliptic hull as near as `clearance_mm` says; one that is nearer already comes no nearer. One that
        presses against a wall, which has held it back by `held_back` (N, 2), presses against what carries it off too.
        """
        if self.clearance_mm is None:
            return carried
        facing_mm, along_mm = self.clearance_mm
        cos, sin = pose[:, 2].cos(), pose[:, 2].sin()
        reach = torch.stack(
            [torch.hypot(facing_mm * cos, along_mm * sin), torch.hypot(facing_mm * sin, along_mm * cos)], dim=-1
        )
        position = pose[:, :2]
        low, high = (torch.as_tensor(corner) for corner in (self.arena_mm.low_mm, self.arena_mm.high_mm))
        lowest, highest = torch.minimum(low + reach, position), torch.maximum(high - reach, position)
        unstopped = position + held_back
        return (unstopped + carried).clamp(lowest, highest) - unstopped.clamp(lowest, highest)

    def wall_distance_mm(self, position: Tensor) -> Tensor:
        """Return the distances (...) of positions (..., 2) from the nearest wall, 0 beyond it."""
        low, high = (torch.as_tensor(corner) for corner in (self.arena_mm.low_mm, self.arena_mm.high_mm))
        nearest = torch.minimum(position - low, high - position).amin(dim=-1)
        return nearest.clamp(min=0.0)
