"""Parts of what tasks measure, for one vehicle in each of several worlds at a time: the lanes.

The compiler can compute several lanes in one instruction, so arrays are (..., lanes) float32: x and y (K, lanes) in mm
in the arena's frame, cos and sin of the headings likewise. Counterparts of `world/observations.py` and `Task.events`.
"""

import math

import numpy as np

from swarmtwin.compiled import compiled
from swarmtwin.world.compiled.elementary import cos_and_sin, exponential


@compiled
def load(pose, first, count, x, y, cos, sin):  # type: ignore[no-untyped-def]
    """Take K vehicles of the worlds `first` … `first + count` out of poses (W, K, 3) into (K, lanes)."""
    for vehicle in range(pose.shape[1]):
        for lane in range(count):
            x[vehicle, lane] = pose[first + lane, vehicle, 0]
            y[vehicle, lane] = pose[first + lane, vehicle, 1]
        for lane in range(count):
            cos[vehicle, lane], sin[vehicle, lane] = cos_and_sin(pose[first + lane, vehicle, 2])


@compiled
def see(x, y, cos, sin, own, other_x, other_y, other, forward, left):  # type: ignore[no-untyped-def]
    """Write where a vehicle, `own`, sees the place of row `other` of (n, lanes): (lanes,) in its frame, in mm."""
    for lane in range(len(forward)):
        away_x, away_y = other_x[other, lane] - x[own, lane], other_y[other, lane] - y[own, lane]
        forward[lane] = cos[own, lane] * away_x + sin[own, lane] * away_y
        left[lane] = cos[own, lane] * away_y - sin[own, lane] * away_x


@compiled
def show_place(forward, left, direction_forward, direction_left, scaled, distance_mm, target_mm):  # type: ignore[no-untyped-def]
    """Make of where places are seen what is observed of them, five numbers of order 1, and how far they are in mm."""
    for lane in range(len(forward)):
        away_mm = math.sqrt(forward[lane] * forward[lane] + left[lane] * left[lane])
        direction_forward[lane] = forward[lane] / max(away_mm, np.float32(1e-6))
        direction_left[lane] = left[lane] / max(away_mm, np.float32(1e-6))
        forward[lane] /= target_mm
        left[lane] /= target_mm
        scaled[lane] = away_mm / target_mm
        distance_mm[lane] = away_mm


@compiled
def draw_in(forward, left, distance_mm, own, other, range_mm, neighbour_mm):  # type: ignore[no-untyped-def]
    """Scale positions, those beyond the range drawn in to its edge; their distances are (K, n, lanes)."""
    for lane in range(len(forward)):
        drawn_in = min(np.float32(1.0), range_mm / max(distance_mm[own, other, lane], np.float32(1e-6))) / neighbour_mm
        forward[lane] *= drawn_in
        left[lane] *= drawn_in


@compiled
def write_walls(observation, first, column, x, y, cos, sin, own, arena, wall_closeness_mm, count):  # type: ignore[no-untyped-def]
    """Write how close the wall is in eight directions about a vehicle into its observation, from a column on."""
    diagonal, least = np.float32(math.sqrt(0.5)), np.float32(1e-6)
    low_x, low_y, high_x, high_y = arena
    for lane in range(count):
        at_x, at_y = min(max(x[own, lane], low_x), high_x), min(max(y[own, lane], low_y), high_y)
        ahead_x, ahead_y = cos[own, lane], sin[own, lane]
        for direction in range(8):
            along_x = (high_x - at_x if ahead_x > 0 else at_x - low_x) / max(abs(ahead_x), least)
            along_y = (high_y - at_y if ahead_y > 0 else at_y - low_y) / max(abs(ahead_y), least)
            closeness = exponential(-min(along_x, along_y) / wall_closeness_mm)
            observation[first + lane, own, column + direction] = closeness
            ahead_x, ahead_y = diagonal * (ahead_x - ahead_y), diagonal * (ahead_x + ahead_y)


@compiled
def is_outside(x, y, arena, tolerance_mm):  # type: ignore[no-untyped-def]
    """Say whether a place is further outside the arena than a tolerance."""
    low_x, low_y, high_x, high_y = arena
    beyond_x = (x < low_x - tolerance_mm) | (x > high_x + tolerance_mm)
    return beyond_x | (y < low_y - tolerance_mm) | (y > high_y + tolerance_mm)
