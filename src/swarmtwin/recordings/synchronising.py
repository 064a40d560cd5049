"""Poses and commands at times of their own, brought together into rows."""

from collections.abc import Mapping

import numpy as np

from swarmtwin.recordings.recording import Track
from swarmtwin.recordings.resampling import interpolate_poses


def synchronised(
    poses: Mapping[str, tuple[np.ndarray, np.ndarray]],
    commands: Mapping[str, tuple[np.ndarray, np.ndarray]],
    run: str,
    longest_gap_s: float,
) -> list[Track]:
    """Return a track for each vehicle: one row per command at the time it was sent, poses interpolated.

    Args:
        poses: by vehicle, times (S,) and poses (S, 3).
        commands: by vehicle, times (K,) and commands (K, m).
        run: the run's name.
        longest_gap_s: two pictures further apart are not bridged.
    """
    tracks = []
    for vehicle, (sent_s, command) in commands.items():
        seen_s, pose = poses.get(vehicle, (np.empty(0), np.empty((0, 3))))
        tracks.append(Track(run, vehicle, sent_s, command, interpolate_poses(seen_s, pose, sent_s, longest_gap_s)))
    return tracks
