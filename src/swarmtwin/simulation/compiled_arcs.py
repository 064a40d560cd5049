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
        forward, left = _turned(share * _chord(half), pose[row, 2] + half, twist[row, 0], twist[row, 1])
        moved[row, 0], moved[row, 1] = pose[row, 0] + forward, pose[row, 1] + left
        moved[row, 2] = _wrapped(pose[row, 2] + 2 * half)
    return moved


@compiled
def twist_between(start: np.ndarray, end: np.ndarray) -> np.ndarray:
    """Return what `arcs.twist_between` says: a chord points where the vehicle heads halfway, its arc is longer.

    Args:
        start: (N, 3) poses.
        end: (N, 3) poses a period later.
    """
    twist = np.empty_like(start)
    for row in range(len(start)):
        turn = _wrapped(end[row, 2] - start[row, 2])
        away_x, away_y = end[row, 0] - start[row, 0], end[row, 1] - start[row, 1]
        half = 0.5 * turn
        twist[row, 0], twist[row, 1] = _turned(1 / _chord(half), -start[row, 2] - half, away_x, away_y)
        twist[row, 2] = turn
    return twist


@compiled
def displacement_along(twist: np.ndarray) -> np.ndarray:
    """Return what `geometry.exp_map` says of twists (N, 3)."""
    moved = np.empty_like(twist)
    for row in range(len(twist)):
        half = 0.5 * twist[row, 2]
        moved[row, 0], moved[row, 1] = _turned(_chord(half), half, twist[row, 0], twist[row, 1])
        moved[row, 2] = twist[row, 2]
    return moved


@compiled
def twist_along(displacement: np.ndarray) -> np.ndarray:
    """Return what `geometry.log_map` says of displacements (N, 3)."""
    twist = np.empty_like(displacement)
    for row in range(len(displacement)):
        half = 0.5 * displacement[row, 2]
        twist[row, 0], twist[row, 1] = _turned(1 / _chord(half), -half, displacement[row, 0], displacement[row, 1])
        twist[row, 2] = displacement[row, 2]
    return twist


@compiled
def _chord(half: float) -> float:
    """Return the length of the chord of an arc of length 1 that turns by twice an angle."""
    return math.sin(half) / half if half != 0.0 else 1.0


@compiled
def _turned(length: float, angle: float, x: float, y: float) -> tuple[float, float]:
    """Return a vector turned by an angle, and as many times as long as `length` says."""
    along, across = length * math.cos(angle), length * math.sin(angle)
    return along * x - across * y, across * x + along * y


@compiled
def _wrapped(angle: float) -> float:
    """Return an angle in (−π, π]."""
    if angle > math.pi or angle <= -math.pi:
        angle -= 2 * math.pi * math.ceil((angle - math.pi) / (2 * math.pi))
    return angle
