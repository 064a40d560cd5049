"""What is seen of walls in one pass over arrays. numba takes a second to load, and robots do without."""

import math

import numpy as np

from swarmtwin.compiled import compiled


@compiled
def near_walls(pose: np.ndarray, low: np.ndarray, high: np.ndarray, reaches_mm: np.ndarray) -> np.ndarray:
    """Return what `Encoding` says of walls, over one reach after the other, (N, 5 · reaches).

    Args:
        pose: (N, 3) x_mm, y_mm, heading_rad.
        low: (2,) corner of the arena.
        high: (2,) the one across.
        reaches_mm: over which walls fade.
    """
    columns = np.zeros((len(pose), 5 * len(reaches_mm)))
    for row in range(len(pose)):
        cos, sin = math.cos(pose[row, 2]), math.sin(pose[row, 2])
        for wall in range(4):
            axis = wall % 2
            away_mm = pose[row, axis] - low[axis] if wall < 2 else high[axis] - pose[row, axis]
            sign = -1.0 if wall < 2 else 1.0
            ahead = sign * (sin if axis else cos)
            left = sign * (cos if axis else -sin)
            for number in range(len(reaches_mm)):
                near, first = math.exp(-max(away_mm, 0.0) / reaches_mm[number]), 5 * number
                columns[row, first] += near
                columns[row, first + 1] += near * ahead
                columns[row, first + 2] += near * left
                columns[row, first + 3] += near * ahead * ahead
                columns[row, first + 4] += near * ahead * left
    return columns
