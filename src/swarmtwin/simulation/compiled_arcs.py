"""Motion along arcs of circles in one pass over arrays. numba takes a second to load, and robots do without."""

import math

import numpy as np

from swarmtwin.compiled import compiled


@compiled
def moved_along(pose: np.ndarray, twist: np.ndarray, share: float) -> np.ndarray:
    """Return what `arcs.moved_along` says, by the chords of arcs, which point where the vehicle heads halfway.

    Args:
        pose: (N, 3) where vehicles are.
        twist: (N, 3) of a whole period.
        share: of a period, for which it is held.
    """
    moved = np.empty_like(pose)
    for row in range(len(pose)):
        half = 0.5 * share * twist[row, 2]
        chord = share * (math.sin(half) / half if half != 0.0 else 1.0)
        along, across = chord * math.cos(pose[row, 2] + half), chord * math.sin(pose[row, 2] + half)
        moved[row, 0] = pose[row, 0] + along * twist[row, 0] - across * twist[row, 1]
        moved[row, 1] = pose[row, 1] + across * twist[row, 0] + along * twist[row, 1]
        heading = pose[row, 2] + 2 * half
        if heading > math.pi or heading <= -math.pi:
            heading -= 2 * math.pi * math.ceil((heading - math.pi) / (2 * math.pi))
        moved[row, 2] = heading
    return moved
