"""The filter that every command passes: bounded, looked ahead, and weakened or withheld where it may do harm."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from swarmtwin.deploy.control.look_ahead import Ahead, LookAhead
from swarmtwin.deploy.control.settings import SafetySettings
from swarmtwin.robot import Arena, Robot
from swarmtwin.simulation.state import State


@dataclass(frozen=True)
class Decision:
    """What is sent instead of what was requested.

    Attributes:
        command: (V, m) to send.
        scale: (V,) of what was requested, beyond that of rest.
        reasons: for each vehicle why it is not what was requested; empty where it is.
    """

    command: np.ndarray
    scale: np.ndarray
    reasons: tuple[str, ...]


class SafetyFilter:
    """Chooses how much of each vehicle's command is safe beside those of the others.

    Each pair must keep its separation, each vehicle the fence and its distance from obstacles, as far as the simulation
    can say. Where they are too near already, commands are safe that bring them no nearer: so the filter itself never
    locks anybody in.

    Attributes:
        interventions: vehicles and periods in which a command was weakened.
        deadlocks: how often a vehicle was held back for as long as `deadlock_periods`.
    """

    def __init__(
        self,
        robot: Robot,
        arena: Arena,
        vehicles: Sequence[str],
        look_ahead: LookAhead,
        settings: SafetySettings,
        separation_mm: float,
        as_sent: Callable[[np.ndarray], np.ndarray] = lambda command: command,
        obstacles: np.ndarray | None = None,
    ) -> None:
        """Prepare.

        Args:
            robot: whose commands they are.
            arena: whose border is the fence.
            vehicles: their ids, in order.
            look_ahead: says where commands lead.
            settings: margins.
            separation_mm: least distance of two centres.
            as_sent: what is left of commands (..., m) when they are written into a message.
            obstacles: (O, 3) x_mm, y_mm, radius_mm; None: there are none.
        """
        self.interventions = 0
        self.deadlocks = 0
        self._robot = robot
        self._low_mm = arena.low_mm + settings.fence_margin_mm
        self._high_mm = arena.high_mm - settings.fence_margin_mm
        self._vehicles = tuple(vehicles)
        self._look_ahead = look_ahead
        self._settings = settings
        self._separation_mm = separation_mm
        self._as_sent = as_sent
        self._obstacles = np.empty((0, 3)) if obstacles is None else obstacles
        self._clear_mm = max(robot.vehicle_size_mm) / 2 + settings.obstacle_margin_mm
        self._withheld = np.zeros(len(vehicles), int)
        self._tolerance_mm = 0.5  # that a simulated turn on the spot may wander

    def __call__(self, state: State, requested: np.ndarray) -> Decision:
        """Return what may be sent of commands (V, m) that take effect in a state (1, V)."""
        rest = self._robot.command_at_rest
        bounded = np.clip(requested, self._robot.command_low, self._robot.command_high)
        scales = np.array(self._settings.scales)
        candidates = self._as_sent(rest + scales[:, None, None] * (bounded - rest))
        ahead = self._look_ahead(state, candidates)
        alone, pairs = self._allowed_alone(ahead), self._keep_apart(ahead)
        chosen = self._choose(np.logical_and.reduce([*alone.values()]), pairs)
        vehicles = np.arange(len(chosen))
        command = candidates[chosen, vehicles]
        reasons = [self._reason(vehicle, chosen, scales, alone, pairs) for vehicle in range(len(chosen))]
        if len(set(chosen)) > 1 and not self._is_safe(self._look_ahead(state, command[None])):
            moving = scales[chosen] > 0
            chosen = np.full(len(chosen), len(scales) - 1)
            command = candidates[chosen, vehicles]
            reasons = ["withheld: together" if now else before for now, before in zip(moving, reasons, strict=True)]
        beyond = np.abs(requested - bounded).max(axis=1) > 1e-6 * np.abs(bounded).max(initial=1.0)
        reasons = [f"bounded{why and ', '}{why}" if out else why for out, why in zip(beyond, reasons, strict=True)]
        self._count(bounded, scales[chosen])
        return Decision(command, scales[chosen], tuple(reasons))

    def _allowed_alone(self, ahead: Ahead) -> dict[str, np.ndarray]:
        """Return whether each candidate keeps each vehicle from what stands still, (C, V), by what that is."""
        return {"fence": self._keeps_fence(ahead), "obstacle": self._avoids_obstacles(ahead)}

    def _avoids_obstacles(self, ahead: Ahead) -> np.ndarray:
        """Return whether each candidate keeps each vehicle off the obstacles, (C, V)."""
        if not len(self._obstacles):
            return np.ones_like(ahead.spread_mm[:, 0], dtype=bool)
        gap = ahead.gap_mm(self._obstacles) - self._clear_mm
        away = np.linalg.norm(ahead.position_mm[:, 0, :, None] - self._obstacles[:, :2], axis=-1)
        now = (away - self._obstacles[:, 2]).min(axis=-1) - self._clear_mm
        surely = (gap - self._settings.deviations * ahead.spread_mm[:, 1:]).min(axis=1) >= 0
        no_nearer = gap.min(axis=1) >= now - self._tolerance_mm
        kept: np.ndarray = surely | no_nearer
        return kept

    def _keeps_fence(self, ahead: Ahead) -> np.ndarray:
        """Return whether each candidate keeps each vehicle within the fence, (C, V)."""
        clearance = ahead.clearance_mm(self._low_mm, self._high_mm)
        surely = (clearance - self._settings.deviations * ahead.spread_mm)[:, 1:].min(axis=1) >= 0
        no_nearer = clearance[:, 1:].min(axis=1) >= clearance[:, 0] - self._tolerance_mm
        kept: np.ndarray = surely | no_nearer
        return kept

    def _keep_apart(self, ahead: Ahead) -> np.ndarray:
        """Return whether candidates keep two vehicles apart, (C, C, V, V); the first is that of the first vehicle."""
        nearest, spread = ahead.nearest_mm()
        surely = (nearest - self._settings.deviations * spread).min(axis=2) >= self._separation_mm
        now = ahead.position_mm[0, 0]
        apart = np.sqrt(((now[:, None] - now[None]) ** 2).sum(axis=-1))
        no_nearer = nearest.min(axis=2) >= apart - self._tolerance_mm
        kept: np.ndarray = surely | no_nearer | np.eye(len(now), dtype=bool)
        return kept

    def _choose(self, alone: np.ndarray, pairs: np.ndarray) -> np.ndarray:
        """Return the index of each vehicle's candidate, (V,).

        All stand at first. One after the other, who has been held back longest first, is given the strongest command
        that is safe beside what the others have by then; twice, since who yields makes room.
        """
        standing = len(alone) - 1
        chosen = np.full(alone.shape[1], standing)
        order = np.argsort(-self._withheld, kind="stable")
        for _ in range(2):
            for vehicle in order:
                safe = alone[:, vehicle] & pairs[:, chosen, vehicle, np.arange(len(chosen))].all(axis=1)
                chosen[vehicle] = np.argmax(safe) if safe.any() else standing
        return chosen

    def _is_safe(self, joint: Ahead) -> bool:
        return all(kept.all() for kept in (*self._allowed_alone(joint).values(), self._keep_apart(joint)))

    def _reason(
        self,
        vehicle: int,
        chosen: np.ndarray,
        scales: np.ndarray,
        alone: Mapping[str, np.ndarray],
        pairs: np.ndarray,
    ) -> str:
        scale = scales[chosen[vehicle]]
        if scale == 1.0:
            return ""
        causes = [name for name, kept in alone.items() if not kept[0, vehicle]]
        beside = pairs[0, chosen, vehicle, np.arange(len(chosen))]
        causes += [f"vehicle {self._vehicles[other]}" for other in np.flatnonzero(~beside)]
        done = "withheld" if scale == 0 else f"weakened to {scale:.0%}"
        return f"{done}: {', '.join(causes) or 'others'}"

    def _count(self, bounded: np.ndarray, scale: np.ndarray) -> None:
        asked = np.abs(bounded - self._robot.command_at_rest).max(axis=1) > 0
        self.interventions += int((asked & (scale < 1)).sum())
        self._withheld = np.where(asked & (scale == 0), self._withheld + 1, 0)
        self.deadlocks += int((self._withheld == self._settings.deadlock_periods).sum())
