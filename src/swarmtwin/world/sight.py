"""What a vehicle sees, in its own frame (x forward, y left): the parts that observations are put together from.

Lengths are scaled to be of order 1. What is near matters more than what is far, so neighbours, obstacles and walls also
show their closeness, which is 1 at contact and fades with the distance; beyond `SIGHT_MM` only their direction counts.
"""

import numpy as np

from swarmtwin.geometry import rotate
from swarmtwin.robot import Arena
from swarmtwin.world.scene import Scene

TARGET_SCALE_MM = 500.0
SIGHT_MM = 400.0
SIGHT_SCALE_MM = 200.0
CLOSENESS_MM = 100.0
WALL_CLOSENESS_MM = 250.0
WALL_DIRECTIONS = ("ahead", "ahead_left", "left", "behind_left", "behind", "behind_right", "right", "ahead_right")
TINY_MM = 1e-6

TARGET_NAMES = ("forward", "left", "direction_forward", "direction_left", "distance")
NEIGHBOUR_NAMES = ("forward", "left", "closeness", "cos_heading", "sin_heading")
OBSTACLE_NAMES = ("forward", "left", "closeness", "radius")


def target_sight_names() -> tuple[str, ...]:
    """Names of what `target_sight` shows."""
    return tuple(f"target_{name}" for name in TARGET_NAMES)


def neighbour_sight_names(neighbours: int) -> tuple[str, ...]:
    """Names of what `neighbour_sight` shows; neighbour 1 is the nearest."""
    return tuple(f"neighbour_{rank}_{name}" for rank in range(1, neighbours + 1) for name in NEIGHBOUR_NAMES)


def obstacle_sight_names(obstacles: int) -> tuple[str, ...]:
    """Names of what `obstacle_sight` shows; obstacle 1 is the nearest."""
    return tuple(f"obstacle_{rank}_{name}" for rank in range(1, obstacles + 1) for name in OBSTACLE_NAMES)


def wall_sight_names() -> tuple[str, ...]:
    """Names of what `wall_sight` shows."""
    return tuple(f"wall_{direction}_closeness" for direction in WALL_DIRECTIONS)


def target_sight(scene: Scene, pose: np.ndarray) -> np.ndarray:
    """Return where the target is, (W, K, 5): scaled position, unit direction, scaled distance."""
    position = rotate(scene.target[:, None] - pose[..., :2], -pose[..., 2])
    distance_mm = np.hypot(position[..., 0], position[..., 1])[..., None]
    direction = position / np.maximum(distance_mm, TINY_MM)
    return np.concatenate([position / TARGET_SCALE_MM, direction, distance_mm / TARGET_SCALE_MM], axis=-1)


def between_vehicles_mm(pose: np.ndarray) -> np.ndarray:
    """Return the distances (W, K, K) between the centres of vehicles at (W, K, 3); infinite from one to itself."""
    away = pose[:, None, :, :2] - pose[:, :, None, :2]
    distance_mm = np.hypot(away[..., 0], away[..., 1])
    itself = np.arange(pose.shape[1])
    distance_mm[:, itself, itself] = np.inf
    return distance_mm


def neighbour_sight(pose: np.ndarray, contact_mm: float) -> np.ndarray:
    """Return the other vehicles, nearest first, (W, K, (K − 1) · 5): position, closeness, cos and sin of the heading.

    Which vehicle it is does not show. `contact_mm` is the distance of two centres at which they collide.
    """
    worlds, vehicles = pose.shape[:2]
    distance_mm = between_vehicles_mm(pose)
    position = rotate(pose[:, None, :, :2] - pose[:, :, None, :2], -pose[:, :, None, 2])
    heading_rad = pose[:, None, :, 2] - pose[:, :, None, 2]
    seen = np.concatenate(
        [
            _within_sight(position, distance_mm),
            _closeness(distance_mm - contact_mm)[..., None],
            np.cos(heading_rad)[..., None],
            np.sin(heading_rad)[..., None],
        ],
        axis=-1,
    )
    nearest_first = np.argsort(distance_mm, axis=-1, kind="stable")[..., :-1, None]
    return np.take_along_axis(seen, nearest_first, axis=2).reshape(worlds, vehicles, -1)


def obstacle_sight(scene: Scene, pose: np.ndarray, contact_mm: float) -> np.ndarray:
    """Return the obstacles, nearest edge first, (W, K, O · 4): position of the centre, closeness, scaled radius.

    A vehicle touches an obstacle when its centre is nearer than `contact_mm` to the edge.
    """
    worlds, vehicles = pose.shape[:2]
    position = rotate(scene.obstacles[:, None, :, :2] - pose[:, :, None, :2], -pose[:, :, None, 2])
    distance_mm = np.hypot(position[..., 0], position[..., 1])
    gap_mm = edge_distance_mm(scene, pose) - contact_mm
    radius = np.broadcast_to(scene.obstacles[:, None, :, 2] / SIGHT_SCALE_MM, gap_mm.shape)
    seen = np.concatenate(
        [_within_sight(position, distance_mm), _closeness(gap_mm)[..., None], radius[..., None]], axis=-1
    )
    nearest_first = np.argsort(gap_mm, axis=-1, kind="stable")[..., None]
    return np.take_along_axis(seen, nearest_first, axis=2).reshape(worlds, vehicles, -1)


def edge_distance_mm(scene: Scene, pose: np.ndarray) -> np.ndarray:
    """Return the distances (W, K, O) from the vehicles' centres to the obstacles' edges; negative inside."""
    away = scene.obstacles[:, None, :, :2] - pose[:, :, None, :2]
    return np.hypot(away[..., 0], away[..., 1]) - scene.obstacles[:, None, :, 2]


def wall_sight(pose: np.ndarray, arena: Arena) -> np.ndarray:
    """Return how close the wall is, straight on in eight directions about the vehicle, (W, K, 8): 1 at the wall."""
    angle_rad = pose[..., 2, None] + np.arange(len(WALL_DIRECTIONS)) * (2 * np.pi / len(WALL_DIRECTIONS))
    direction = np.stack([np.cos(angle_rad), np.sin(angle_rad)], axis=-1)
    inside = np.clip(pose[..., :2], arena.low_mm, arena.high_mm)[..., None, :]
    room_mm = np.where(direction > 0, arena.high_mm - inside, inside - arena.low_mm)
    along_mm = room_mm / np.maximum(np.abs(direction), TINY_MM)
    return np.exp(-along_mm.min(axis=-1) / WALL_CLOSENESS_MM)


def _within_sight(position: np.ndarray, distance_mm: np.ndarray) -> np.ndarray:
    """Scale positions (..., 2); those beyond sight are drawn in to its edge."""
    drawn_in = np.minimum(1.0, SIGHT_MM / np.maximum(distance_mm, TINY_MM))
    return position * (drawn_in / SIGHT_SCALE_MM)[..., None]


def _closeness(gap_mm: np.ndarray) -> np.ndarray:
    return np.exp(-gap_mm / CLOSENESS_MM)
