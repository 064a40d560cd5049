"""Random places that keep their distance from each other, and how many of them there is room for."""

import numpy as np

TRIES = 200
CANDIDATES = 5_000
COMFORT = 0.85


def inner_room(low_mm: np.ndarray, high_mm: np.ndarray, share: float) -> tuple[np.ndarray, np.ndarray]:
    """Return the corners (2,) of the rectangle within another that has the same centre and a share of its sides."""
    centre, half = (low_mm + high_mm) / 2, share * (high_mm - low_mm) / 2
    return centre - half, centre + half


def draw_apart(
    rng: np.random.Generator,
    count: int,
    room_mm: tuple[np.ndarray, np.ndarray],
    apart_mm: float,
    taken: np.ndarray,
) -> np.ndarray:
    """Draw `count` uniform places in each of W rectangles, each at least `apart_mm` from the others.

    Args:
        rng: where the chances come from.
        count: places in a rectangle; `room_for` says how many there may be.
        room_mm: the rectangle's corners, (2,) and (2,).
        apart_mm: least distance between two places of a rectangle.
        taken: (W, n, 3) x_mm, y_mm, radius_mm of circles in which no place may lie.

    Returns:
        (W, count, 2).
    """
    places = np.full((len(taken), count, 2), np.nan)
    unfinished = np.arange(len(taken))
    while len(unfinished):
        places[unfinished] = np.nan
        for index in range(count):
            _place_one(rng, places, index, unfinished, room_mm, apart_mm, taken)
        unfinished = np.flatnonzero(np.isnan(places).any(axis=(1, 2)))
    return places


def _place_one(
    rng: np.random.Generator,
    places: np.ndarray,
    index: int,
    worlds: np.ndarray,
    room_mm: tuple[np.ndarray, np.ndarray],
    apart_mm: float,
    taken: np.ndarray,
) -> None:
    """Fill in place `index` of some worlds; after many tries it stays NaN."""
    for _ in range(TRIES):
        drawn = rng.uniform(*room_mm, (len(worlds), 2))
        near_another = _distance_mm(places[worlds, :index], drawn) < apart_mm
        in_circle = _distance_mm(taken[worlds, :, :2], drawn) < taken[worlds, :, 2]
        free = ~(near_another.any(axis=1) | in_circle.any(axis=1))
        places[worlds[free], index] = drawn[free]
        worlds = worlds[~free]
        if not len(worlds):
            return


def _distance_mm(places: np.ndarray, drawn: np.ndarray) -> np.ndarray:
    """Return the distances (W, n) from places (W, n, 2) to one drawn place each (W, 2)."""
    away = places - drawn[:, None]
    return np.hypot(away[..., 0], away[..., 1])


def room_for(count: int, room_mm: tuple[np.ndarray, np.ndarray], apart_mm: float, taken: np.ndarray) -> int:
    """Return `count`, or how many places can be drawn in the rectangle at ease, where that is less.

    Random places block each other long before the rectangle is full; so they are counted by trying, and a share of what
    was reached can be drawn quickly.

    Args:
        count: places wanted.
        room_mm: the rectangle's corners, (2,) and (2,).
        apart_mm: least distance between two places.
        taken: (n, 3) x_mm, y_mm, radius_mm of circles in which no place may lie.
    """
    area = np.prod(room_mm[1] - room_mm[0])
    blocked = np.pi * ((count - 1) * apart_mm**2 + (taken[:, 2] ** 2).sum())
    if blocked < COMFORT * area:
        return count
    candidates = np.random.default_rng(0).uniform(*room_mm, (CANDIDATES, 2))
    for x_mm, y_mm, radius_mm in taken:
        candidates = candidates[np.hypot(*(candidates - (x_mm, y_mm)).T) >= radius_mm]
    reached = 0
    while len(candidates):
        candidates = candidates[np.hypot(*(candidates - candidates[0]).T) >= max(apart_mm, 1e-9)]
        reached += 1
    return min(count, max(1, int(COMFORT * reached)))
