"""The operator who drives: random commands over the limits (paper, section 3.2), steered back from the edges."""

from dataclasses import dataclass
from typing import Literal

import numpy as np

from swarmtwin.geometry import compose
from swarmtwin.robot import Robot
from swarmtwin.standin.physics import STAND_INS, Physics
from swarmtwin.standin.streams import Streams

CommandMode = Literal["uniform", "gentle", "held", "waypoints", "smooth", "published"]


@dataclass(frozen=True)
class CommandPlan:
    """What the operator drew in advance for R runs of T periods with V vehicles.

    Attributes:
        start: (R, V, 3) poses to begin from.
        wanted: (R, T, V, m) commands to give while all goes well.
        choices: (R, T, V, choices, m) commands to steer with.
        goal_mm: (R, T, V, 2) where to steer.
        always_steers: whether every command is chosen by where it leads, not only those near the edge.
    """

    start: np.ndarray
    wanted: np.ndarray
    choices: np.ndarray
    goal_mm: np.ndarray
    always_steers: bool


@dataclass(frozen=True)
class Operator:
    """How the operator drives.

    Attributes:
        choices: how many random commands there are to choose from where it steers.
        command_decimals: to which commands are rounded.
        held_periods: how long a command is held in the mode `held`.
        smooth_periods: over how many periods commands resemble each other in the mode `smooth`.
        waypoint_periods: how long a place is steered for in the mode `waypoints`.
        look_ahead_periods: how far ahead a choice is judged.
        edge_share: of the arena's shorter side: nearer to the edge than this the operator steers back.
    """

    choices: int = 8
    command_decimals: int = 1
    held_periods: int = 4
    smooth_periods: float = 4.0
    waypoint_periods: int = 12
    look_ahead_periods: int = 3
    edge_share: float = 0.16

    def plan(
        self,
        robot: Robot,
        shape: tuple[int, int, int],
        command_mode: CommandMode,
        drive: np.ndarray | None,
        streams: Streams,
    ) -> CommandPlan:
        """Draw for `shape` = (R, T, V), or play `drive` (R, T, m)."""
        run_count, step_count, vehicle_count = shape
        low, high = robot.command_low, robot.command_high
        if command_mode == "gentle":
            low, high = low + (high - low) / 4, high - (high - low) / 4
        share = streams.of("commands").random((run_count, step_count, vehicle_count, 1 + self.choices, len(low)))
        if command_mode == "smooth":
            share[:, :, :, 0] = self._smoothed(share[:, :, :, 0])
        published = STAND_INS.plugin_class(robot.name).published if command_mode == "published" else None
        if published is not None:
            low, high = np.array([limits[:2] for limits in published]).T
            levels = np.array([limits[2] or 1_000_000 for limits in published])
            share = np.floor(share * levels) / (levels - 1)
        commands = np.round(low + (high - low) * share, self.command_decimals)
        wanted = commands[:, :, :, 0]
        if command_mode == "held":
            wanted = wanted[:, np.arange(step_count) // self.held_periods * self.held_periods]
        if drive is not None:
            wanted = np.broadcast_to(drive[:, :, None], wanted.shape)
        goal_mm = self._inside(robot, streams.of("waypoints").random((run_count, step_count, vehicle_count, 2)))
        goal_mm = goal_mm[:, np.arange(step_count) // self.waypoint_periods * self.waypoint_periods]
        if command_mode != "waypoints" or drive is not None:
            goal_mm = np.broadcast_to((robot.arena_mm.low_mm + robot.arena_mm.high_mm) / 2, goal_mm.shape)
        start = self._start_poses(robot, run_count, vehicle_count, streams)
        return CommandPlan(start, wanted, commands[:, :, :, 1:], goal_mm, command_mode == "waypoints" and drive is None)

    def steer(self, robot: Robot, physics: Physics, pose: np.ndarray, plan: CommandPlan, step: int) -> np.ndarray:
        """Return commands (R, V, m) for vehicles at poses (R, V, 3).

        Inside the arena they are as wanted; near its edge, or where the plan always steers, they are those of the drawn
        choices that lead nearest to the goal, so still random.
        """
        choices = plan.choices[:, step]
        ahead = physics.guess(choices)
        reached = np.broadcast_to(pose[:, :, None], ahead.shape)
        for _ in range(self.look_ahead_periods):
            reached = compose(reached, ahead)
        from_goal_mm = np.linalg.norm(reached[..., :2] - plan.goal_mm[:, step, :, None], axis=-1)
        best = np.take_along_axis(choices, np.argmin(from_goal_mm, axis=-1)[..., None, None], axis=2)[:, :, 0]
        margin_mm, position_mm = self._margin_mm(robot), pose[..., :2]
        low, high = robot.arena_mm.low_mm + margin_mm, robot.arena_mm.high_mm - margin_mm
        free = np.all((position_mm > low) & (position_mm < high), axis=-1) & (not plan.always_steers)
        return np.where(free[..., None], plan.wanted[:, step], best)

    def _smoothed(self, share: np.ndarray) -> np.ndarray:
        """Return shares (R, T, V, m), still uniform over [0, 1], that change gradually from period to period."""
        from scipy.special import ndtr, ndtri  # a third of the time that a robot of a fleet takes to start

        normal = ndtri(np.clip(share, 1e-9, 1.0 - 1e-9))
        kept = np.exp(-1.0 / self.smooth_periods)
        for step in range(1, normal.shape[1]):
            normal[:, step] = kept * normal[:, step - 1] + np.sqrt(1.0 - kept**2) * normal[:, step]
        smoothed: np.ndarray = ndtr(normal)
        return smoothed

    def _margin_mm(self, robot: Robot) -> float:
        return self.edge_share * float(np.min(robot.arena_mm.high_mm - robot.arena_mm.low_mm))

    def _inside(self, robot: Robot, share: np.ndarray) -> np.ndarray:
        """Return points (..., 2) of the arena's inner part from shares (..., 2) of it."""
        low, high, margin_mm = robot.arena_mm.low_mm, robot.arena_mm.high_mm, self._margin_mm(robot)
        return low + margin_mm + (high - low - 2 * margin_mm) * share

    def _start_poses(self, robot: Robot, run_count: int, vehicle_count: int, streams: Streams) -> np.ndarray:
        """Return start poses (R, V, 3): each vehicle, of random places, at the one farthest from those before it."""
        shape = (run_count, vehicle_count, self.choices, 2)
        places_mm = self._inside(robot, streams.of("start places").random(shape))
        heading_rad = streams.of("start headings").uniform(-np.pi, np.pi, (run_count, vehicle_count, 1))
        chosen = places_mm[:, :1, 0]
        for vehicle in range(1, vehicle_count):
            apart_mm = np.linalg.norm(places_mm[:, vehicle, :, None] - chosen[:, None], axis=-1).min(axis=-1)
            best = np.argmax(apart_mm, axis=-1)
            chosen = np.concatenate([chosen, places_mm[np.arange(run_count), vehicle, best][:, None]], axis=1)
        return np.concatenate([chosen, heading_rad], axis=-1)
