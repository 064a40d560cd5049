"""What a vehicle observes, in its own frame (x forward, y left): the parts that observations are put together from.

Lengths are scaled to be of order 1. What is near matters more than what is far, so neighbours, obstacles and walls also
show their closeness, which is 1 at contact and fades exponentially with the distance.
"""

import numpy as np

from swarmtwin.geometry import rotate
from swarmtwin.robot import Arena, Positive, StrictModel
from swarmtwin.world.neighbours import nearest_others
from swarmtwin.world.scenario import Scenario

WALL_DIRECTIONS = ("ahead", "ahead_left", "left", "behind_left", "behind", "behind_right", "right", "ahead_right")


class ObservationScaling(StrictModel):
    """How lengths in mm become numbers of order 1.

    Attributes:
        target_mm: a target at this distance has the distance 1.
        range_mm: of a neighbour or an obstacle further away than this, only the direction shows.
        neighbour_mm: a neighbour or an obstacle at this distance has the distance 1.
        closeness_mm: the closeness of a neighbour or an obstacle falls to 1/e over this distance from contact.
        wall_closeness_mm: that of a wall likewise.
    """

    target_mm: Positive = 500.0
    range_mm: Positive = 400.0
    neighbour_mm: Positive = 200.0
    closeness_mm: Positive = 100.0
    wall_closeness_mm: Positive = 250.0


def target_names() -> tuple[str, ...]:
    """Names of what `observe_target` returns."""
    return tuple(f"target_{name}" for name in ("forward", "left", "direction_forward", "direction_left", "distance"))


def neighbour_names(neighbours: int) -> tuple[str, ...]:
    """Names of what `observe_neighbours` returns; neighbour 1 is the nearest."""
    names = ("forward", "left", "closeness", "cos_heading", "sin_heading")
    return tuple(f"neighbour_{rank}_{name}" for rank in range(1, neighbours + 1) for name in names)


def obstacle_names(obstacles: int) -> tuple[str, ...]:
    """Names of what `observe_obstacles` returns; obstacle 1 is the nearest."""
    names = ("forward", "left", "closeness", "radius")
    return tuple(f"obstacle_{rank}_{name}" for rank in range(1, obstacles + 1) for name in names)


def wall_names() -> tuple[str, ...]:
    """Names of what `observe_walls` returns."""
    return tuple(f"wall_{direction}_closeness" for direction in WALL_DIRECTIONS)


def observe_target(scenario: Scenario, pose: np.ndarray, scaling: ObservationScaling) -> np.ndarray:
    """Return where each vehicle's target is, (W, K, 5); see `observe_place`."""
    return observe_place(scenario.target_of_each, pose, scaling)


def observe_place(place: np.ndarray, pose: np.ndarray, scaling: ObservationScaling) -> np.ndarray:
    """Return where places (W, K, 2), or (W, 1, 2), are, (W, K, 5): scaled position, unit direction, scaled distance."""
    position = rotate(place - pose[..., :2], -pose[..., 2])
    distance_mm = np.hypot(position[..., 0], position[..., 1])[..., None]
    direction = position / np.maximum(distance_mm, 1e-6)  # 0 at the target itself
    return np.concatenate([position / scaling.target_mm, direction, distance_mm / scaling.target_mm], axis=-1)


def observe_neighbours(
    pose: np.ndarray,
    contact_mm: float,
    scaling: ObservationScaling,
    nearest: int | None = None,
    within_mm: float | None = None,
) -> np.ndarray:
    """Return the other vehicles, nearest first, (W, K, n · 5): position, closeness, cos and sin of the heading.

    Which vehicle it is does not show. Where there are fewer than n within sight, nobody is there: straight behind at
    the edge of the range, with closeness 0 and no heading, so that it looks like somebody far away who is in nobody's
    way.

    Args:
        pose: (W, K, 3) of all vehicles.
        contact_mm: the distance of two centres at which they collide.
        scaling: how lengths become numbers.
        nearest: how many are shown, n, whatever K is; None: all others, K − 1.
        within_mm: who is further away is not shown; None: everybody is.
    """
    worlds, vehicles = pose.shape[:2]
    shown = vehicles - 1 if nearest is None else nearest
    number, distance_mm = nearest_others(pose, shown, np.inf if within_mm is None else within_mm)
    is_there = np.isfinite(distance_mm)
    other = pose[np.arange(worlds)[:, None, None], number]
    position = rotate(other[..., :2] - pose[:, :, None, :2], -pose[:, :, None, 2])
    heading_rad = other[..., 2] - pose[:, :, None, 2]
    seen = [
        _within_range(position, distance_mm, scaling),
        np.exp(-(distance_mm - contact_mm) / scaling.closeness_mm)[..., None],
        np.cos(heading_rad)[..., None],
        np.sin(heading_rad)[..., None],
    ]
    nobody = np.array([-scaling.range_mm / scaling.neighbour_mm, 0.0, 0.0, 0.0, 0.0])
    observed = np.empty((worlds, vehicles, shown, len(nobody)))
    observed[:] = nobody
    others = number.shape[-1]
    observed[:, :, :others] = np.where(is_there[..., None], np.concatenate(seen, axis=-1), nobody)
    return observed.reshape(worlds, vehicles, -1)


def observe_obstacles(
    scenario: Scenario, pose: np.ndarray, contact_mm: float, scaling: ObservationScaling
) -> np.ndarray:
    """Return the obstacles, nearest edge first, (W, K, O · 4): position of the centre, closeness, scaled radius.

    A vehicle touches an obstacle when its centre is nearer than `contact_mm` to the edge.
    """
    worlds, vehicles = pose.shape[:2]
    position = rotate(scenario.obstacles[:, None, :, :2] - pose[:, :, None, :2], -pose[:, :, None, 2])
    distance_mm = np.hypot(position[..., 0], position[..., 1])
    gap_mm = edge_distance_mm(scenario, pose) - contact_mm
    radius = np.broadcast_to(scenario.obstacles[:, None, :, 2] / scaling.neighbour_mm, gap_mm.shape)
    observed = np.concatenate(
        [
            _within_range(position, distance_mm, scaling),
            np.exp(-gap_mm / scaling.closeness_mm)[..., None],
            radius[..., None],
        ],
        axis=-1,
    )
    nearest_first = np.argsort(gap_mm, axis=-1, kind="stable")[..., None]
    return np.take_along_axis(observed, nearest_first, axis=2).reshape(worlds, vehicles, -1)


def edge_distance_mm(scenario: Scenario, pose: np.ndarray) -> np.ndarray:
    """Return the distances (W, K, O) from the vehicles' centres to the obstacles' edges; negative inside."""
    away = scenario.obstacles[:, None, :, :2] - pose[:, :, None, :2]
    return np.hypot(away[..., 0], away[..., 1]) - scenario.obstacles[:, None, :, 2]


def observe_walls(pose: np.ndarray, arena: Arena, scaling: ObservationScaling) -> np.ndarray:
    """Return how close the wall is, straight on in eight directions about the vehicle, (W, K, 8): 1 at the wall."""
    angle_rad = pose[..., 2, None] + np.arange(len(WALL_DIRECTIONS)) * (2 * np.pi / len(WALL_DIRECTIONS))
    direction = np.stack([np.cos(angle_rad), np.sin(angle_rad)], axis=-1)
    inside = np.clip(pose[..., :2], arena.low_mm, arena.high_mm)[..., None, :]
    room_mm = np.where(direction > 0, arena.high_mm - inside, inside - arena.low_mm)
    along_mm = room_mm / np.maximum(np.abs(direction), 1e-6)  # a wall alongside is far, not infinitely far
    return np.exp(-along_mm.min(axis=-1) / scaling.wall_closeness_mm)


def _within_range(position: np.ndarray, distance_mm: np.ndarray, scaling: ObservationScaling) -> np.ndarray:
    """Scale positions (..., 2); those beyond the range are drawn in to its edge."""
    drawn_in = np.minimum(1.0, scaling.range_mm / np.maximum(distance_mm, 1e-6))
    return position * (drawn_in / scaling.neighbour_mm)[..., None]
