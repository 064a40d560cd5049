"""The operator who drives: random commands over the limits (paper, section 3.2), steered back from the edges."""

from dataclasses import dataclass
from typing import Literal, get_args

import numpy as np

from swarmtwin.geometry import compose
from swarmtwin.robot import Robot
from swarmtwin.standin.physics import Physics
from swarmtwin.standin.streams import Streams

Manner = Literal["uniform", "gentle", "held", "waypoints"]
MANNERS = get_args(Manner)

CHOICES = 8
COMMAND_DECIMALS = 1
HELD_PERIODS = 4
WAYPOINT_PERIODS = 12
LOOK_AHEAD_PERIODS = 3
EDGE_SHARE = 0.16


@dataclass(frozen=True)
class Plan:
    """What the operator drew in advance for R runs of T periods with V vehicles.

    Attributes:
        start: (R, V, 3) poses to begin from.
        wanted: (R, T, V, m) commands to give while all goes well.
        choices: (R, T, V, CHOICES, m) commands to steer with.
        goal_mm: (R, T, V, 2) where to steer.
        always_steers: whether every command is chosen by where it leads, not only those near the edge.
    """

    start: np.ndarray
    wanted: np.ndarray
    choices: np.ndarray
    goal_mm: np.ndarray
    always_steers: bool

    @classmethod
    def draw(
        cls, robot: Robot, shape: tuple[int, int, int], manner: Manner, drive: np.ndarray | None, streams: Streams
    ) -> "Plan":
        """Draw for `shape` = (R, T, V), or play `drive` (R, T, m)."""
        run_count, step_count, vehicle_count = shape
        low, high = robot.command_low, robot.command_high
        if manner == "gentle":
            low, high = low + (high - low) / 4, high - (high - low) / 4
        share = streams.of("commands").random((run_count, step_count, vehicle_count, 1 + CHOICES, len(low)))
        commands = np.round(low + (high - low) * share, COMMAND_DECIMALS)
        wanted = commands[:, :, :, 0]
        if manner == "held":
            wanted = wanted[:, np.arange(step_count) // HELD_PERIODS * HELD_PERIODS]
        if drive is not None:
            wanted = np.broadcast_to(drive[:, :, None], wanted.shape)
        goal_mm = _inside(robot, streams.of("waypoints").random((run_count, step_count, vehicle_count, 2)))
        goal_mm = goal_mm[:, np.arange(step_count) // WAYPOINT_PERIODS * WAYPOINT_PERIODS]
        if manner != "waypoints" or drive is not None:
            goal_mm = np.broadcast_to((robot.arena_mm.low_mm + robot.arena_mm.high_mm) / 2, goal_mm.shape)
        start = _starts(robot, run_count, vehicle_count, streams)
        return cls(start, wanted, commands[:, :, :, 1:], goal_mm, manner == "waypoints" and drive is None)


def steer(robot: Robot, physics: Physics, pose: np.ndarray, plan: Plan, step: int) -> np.ndarray:
    """Return commands (R, V, m) for vehicles at poses (R, V, 3).

    Inside the arena they are as wanted; near its edge, or where the plan always steers, they are those of the drawn
    choices that lead nearest to the goal, so still random.
    """
    ahead = physics.guess(plan.choices[:, step])
    reached = np.broadcast_to(pose[:, :, None], ahead.shape)
    for _ in range(LOOK_AHEAD_PERIODS):
        reached = compose(reached, ahead)
    from_goal_mm = np.linalg.norm(reached[..., :2] - plan.goal_mm[:, step, :, None], axis=-1)
    best = np.take_along_axis(plan.choices[:, step], np.argmin(from_goal_mm, axis=-1)[..., None, None], axis=2)[:, :, 0]
    margin_mm = EDGE_SHARE * float(np.min(robot.arena_mm.high_mm - robot.arena_mm.low_mm))
    position_mm = pose[..., :2]
    inside = np.all(
        (position_mm > robot.arena_mm.low_mm + margin_mm) & (position_mm < robot.arena_mm.high_mm - margin_mm), axis=-1
    )
    free = inside & (not plan.always_steers)
    return np.where(free[..., None], plan.wanted[:, step], best)


def _inside(robot: Robot, share: np.ndarray) -> np.ndarray:
    """Return points (..., 2) of the arena's inner part from shares (..., 2) of it."""
    low, high = robot.arena_mm.low_mm, robot.arena_mm.high_mm
    margin_mm = EDGE_SHARE * float(np.min(high - low))
    return low + margin_mm + (high - low - 2 * margin_mm) * share


def _starts(robot: Robot, run_count: int, vehicle_count: int, streams: Streams) -> np.ndarray:
    """Return start poses (R, V, 3): each vehicle, of eight random places, at the one farthest from those before it."""
    places_mm = _inside(robot, streams.of("start places").random((run_count, vehicle_count, CHOICES, 2)))
    heading_rad = streams.of("start headings").uniform(-np.pi, np.pi, (run_count, vehicle_count, 1))
    chosen = places_mm[:, :1, 0]
    for vehicle in range(1, vehicle_count):
        apart_mm = np.linalg.norm(places_mm[:, vehicle, :, None] - chosen[:, None], axis=-1).min(axis=-1)
        best = np.argmax(apart_mm, axis=-1)
        chosen = np.concatenate([chosen, places_mm[np.arange(run_count), vehicle, best][:, None]], axis=1)
    return np.concatenate([chosen, heading_rad], axis=-1)
