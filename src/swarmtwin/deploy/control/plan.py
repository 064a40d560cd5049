"""What a deployment is to be: who drives where, what looks ahead, and all that can be set."""

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np

from swarmtwin.deploy.control.journal import reserved_bytes
from swarmtwin.deploy.control.settings import SafetySettings, TimingSettings, WatchSettings
from swarmtwin.robot import Arena, Robot
from swarmtwin.simulation.simulation import Simulation


@dataclass(frozen=True)
class Plan:
    """What a deployment is to be.

    Attributes:
        robot: what is driven, with its link and marker.
        vehicles: ids, in order.
        arena: whose border is the fence.
        simulation: that predicts, looks ahead and is compared with.
        link: how a supervisor connects, as `connect_by` wants it; None: there is no supervisor, as in some tests.
        collision_mm: what the task calls a collision of two centres; None: it knows none.
        periods: that are planned, in all runs together.
        obstacles: round ones that stand in the arena, (x_mm, y_mm, radius_mm) each.
        watches: whether vehicles are compared with the simulation.
        safety: limits and margins.
        timing: when it acts.
        watch: how it compares.
        pictures_per_s: at most, for the space that is reserved.
        wait_s: for how long all vehicles are waited for at the start.
    """

    robot: Robot
    vehicles: tuple[str, ...]
    arena: Arena
    simulation: Simulation
    link: Mapping[str, Any] | None
    collision_mm: float | None
    periods: int
    obstacles: tuple[tuple[float, float, float], ...] = ()
    watches: bool = True
    safety: SafetySettings = field(default_factory=SafetySettings)
    timing: TimingSettings = field(default_factory=TimingSettings)
    watch: WatchSettings = field(default_factory=WatchSettings)
    pictures_per_s: float = 60.0
    wait_s: float = 10.0

    def with_supervisor(self, link: Mapping[str, Any]) -> "Plan":
        """Return the plan with a supervisor that connects as told."""
        return replace(self, link=link)

    @property
    def obstacle_table(self) -> np.ndarray:
        """The obstacles as (O, 3)."""
        return np.array(self.obstacles, float).reshape(-1, 3)

    @property
    def separation_mm(self) -> float:
        """Which distance of two centres commands must keep."""
        usual_mm = 1.3 * max(self.robot.vehicle_size_mm) if self.collision_mm is None else 1.1 * self.collision_mm
        return self.safety.separation_mm or usual_mm

    @property
    def too_near_mm(self) -> float:
        """At which distance of two centres all stop."""
        usual_mm = min(self.robot.vehicle_size_mm) if self.collision_mm is None else 0.9 * self.collision_mm
        return self.safety.too_near_mm or usual_mm

    @property
    def journal_bytes(self) -> int:
        """How much space the journal may need."""
        duration_s = (self.periods + 60) * self.robot.period_s + self.wait_s + 120.0
        return reserved_bytes(len(self.vehicles), self.periods + 2000, int(duration_s * self.pictures_per_s))
