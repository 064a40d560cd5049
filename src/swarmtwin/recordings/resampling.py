"""Streams sampled at any times, brought to a robot's control period without inventing anything across gaps."""

import numpy as np

from swarmtwin.geometry import wrap_angle


def interpolate_poses(time_s: np.ndarray, pose: np.ndarray, at_s: np.ndarray, longest_gap_s: float) -> np.ndarray:
    """Interpolate poses linearly in time, the heading along the shorter arc.

    Args:
        time_s: (S,) strictly increasing.
        pose: (S, 3) x, y, heading measured then.
        at_s: (K,) times wanted.
        longest_gap_s: two samples further apart are not bridged.

    Returns:
        (K, 3) poses, headings in (−π, π]; NaN outside the samples and within a gap.
    """
    if len(time_s) < 2:
        return np.full((len(at_s), 3), np.nan)
    before = np.clip(np.searchsorted(time_s, at_s, side="right") - 1, 0, len(time_s) - 2)
    start_s, end_s = time_s[before], time_s[before + 1]
    share = ((at_s - start_s) / (end_s - start_s))[:, None]
    change = pose[before + 1] - pose[before]
    change[:, 2] = wrap_angle(change[:, 2])
    interpolated = pose[before] + share * change
    interpolated[:, 2] = wrap_angle(interpolated[:, 2])
    known = (at_s >= time_s[0]) & (at_s <= time_s[-1])
    known &= (end_s - start_s <= longest_gap_s) | (at_s == start_s) | (at_s == end_s)
    return np.where(known[:, None], interpolated, np.nan)


def mean_held(time_s: np.ndarray, values: np.ndarray, edges_s: np.ndarray, longest_hold_s: float) -> np.ndarray:
    """Average commands over intervals, each command held until the next: the time-weighted mean.

    Args:
        time_s: (S,) strictly increasing.
        values: (S, m) commands sent then.
        edges_s: (K + 1,) increasing; the intervals lie between neighbours.
        longest_hold_s: a command is taken to hold no longer than this.

    Returns:
        (K, m) means; NaN for an interval during any part of which no command is known.
    """
    hold_s = np.minimum(np.diff(time_s), longest_hold_s)
    held = np.vstack([np.zeros(values.shape[1]), np.cumsum(values[:-1] * hold_s[:, None], axis=0)])
    covered_s = np.append(0.0, np.cumsum(hold_s))
    last = np.searchsorted(time_s, edges_s, side="right") - 1
    since_s = np.where(last >= 0, np.clip(edges_s - time_s[last], 0.0, longest_hold_s), 0.0)
    total = held[last.clip(0)] + values[last.clip(0)] * since_s[:, None]
    total_s = covered_s[last.clip(0)] + since_s
    length_s = np.diff(edges_s)
    complete = (np.diff(total_s) >= length_s - 1e-6) & (length_s > 0)
    mean = np.full((len(length_s), values.shape[1]), np.nan)
    mean[complete] = np.diff(total, axis=0)[complete] / length_s[complete, None]
    return mean
