"""Which vehicles are near which: all pairs of a small group, a search tree for a large one, with the same result."""

from typing import NamedTuple

import numpy as np
from scipy.spatial import KDTree


class Neighbours(NamedTuple):
    """The n nearest others of each of W · K vehicles, nearest first.

    Attributes:
        number: (W, K, n) which vehicle of the same world it is; any where there is nobody.
        distance_mm: (W, K, n) between the two centres; infinite where there is nobody.
    """

    number: np.ndarray
    distance_mm: np.ndarray


def between_vehicles_mm(pose: np.ndarray) -> np.ndarray:
    """Return the distances (W, K, K) between the centres of vehicles at (W, K, 3); infinite from one to itself."""
    away = pose[:, None, :, :2] - pose[:, :, None, :2]
    distance_mm = np.hypot(away[..., 0], away[..., 1])
    itself = np.arange(pose.shape[1])
    distance_mm[:, itself, itself] = np.inf
    return distance_mm


def nearest_others(pose: np.ndarray, count: int, within_mm: float = np.inf, all_pairs_up_to: int = 20) -> Neighbours:
    """Find the nearest others of vehicles at (W, K, 3).

    Args:
        pose: x_mm, y_mm, heading_rad.
        count: how many are looked for, n; never more than there are others.
        within_mm: those further away than this are nobody.
        all_pairs_up_to: larger groups are searched by a tree, whose effort does not grow with the square of K.
    """
    vehicles = pose.shape[1]
    count = min(count, vehicles - 1)
    if vehicles <= all_pairs_up_to:
        distance_mm = between_vehicles_mm(pose)
        index = np.argsort(distance_mm, axis=-1, kind="stable")[..., :count]
        distance_mm = np.take_along_axis(distance_mm, index, axis=-1)
    else:
        index, distance_mm = _nearest_by_tree(pose, count, within_mm)
    return Neighbours(index, np.where(distance_mm <= within_mm, distance_mm, np.inf))


def others_nearer_than(pose: np.ndarray, radius_mm: float, all_pairs_up_to: int = 20) -> np.ndarray:
    """Return how many others are nearer than `radius_mm` to each vehicle at (W, K, 3), (W, K)."""
    worlds, vehicles = pose.shape[:2]
    if vehicles <= all_pairs_up_to:
        return np.asarray((between_vehicles_mm(pose) < radius_mm).sum(axis=-1))
    place = _apart_by_world(pose, radius_mm)
    pairs = KDTree(place).query_pairs(radius_mm, output_type="ndarray")
    away = place[pairs[:, 0], :2] - place[pairs[:, 1], :2]
    near = pairs[np.hypot(away[:, 0], away[:, 1]) < radius_mm]
    return np.bincount(near.ravel(), minlength=len(place)).reshape(worlds, vehicles)


def _nearest_by_tree(pose: np.ndarray, count: int, within_mm: float) -> tuple[np.ndarray, np.ndarray]:
    """Return index and distance (W, K, n), those at equal distances in their order; infinitely far beyond the range."""
    worlds, vehicles = pose.shape[:2]
    place = _apart_by_world(pose, 0.0)
    everyone = np.arange(len(place))
    ranks = np.arange(1, count + 2)
    _, found = KDTree(place).query(place, ranks, distance_upper_bound=np.nextafter(within_mm, np.inf))
    exists = found < len(place)
    other = np.where(exists, found, 0)
    away = place[other, :2] - place[:, None, :2]
    is_another = exists & (found != everyone[:, None])
    distance_mm = np.where(is_another, np.hypot(away[..., 0], away[..., 1]), np.inf)
    order = np.lexsort((other, distance_mm), axis=-1)[:, :count]
    shape = (worlds, vehicles, count)
    index = np.take_along_axis(other, order, axis=-1) % vehicles
    return index.reshape(shape), np.take_along_axis(distance_mm, order, axis=-1).reshape(shape)


def _apart_by_world(pose: np.ndarray, radius_mm: float) -> np.ndarray:
    """Return places (W · K, 3) for one tree: worlds lie above each other, further apart than any is wide."""
    worlds, vehicles = pose.shape[:2]
    position = pose[..., :2]
    width_mm = np.hypot(*(position.max(axis=(0, 1)) - position.min(axis=(0, 1))))
    height_mm = np.arange(worlds) * (2.0 * max(width_mm, radius_mm) + 1.0)
    above = np.broadcast_to(height_mm[:, None, None], (worlds, vehicles, 1))
    return np.concatenate([position, above], axis=-1).reshape(-1, 3)
