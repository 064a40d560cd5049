"""Poses and commands at times of their own, brought together into rows."""

from collections.abc import Mapping, Sequence

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

    A row outside the pictures, or between two that are too far apart, has a pose of NaN; so has every row of a vehicle
    that was not seen. Poses that are not in order of time are put so, and of two at one time the first is taken.
    """
    tracks = []
    for vehicle, (sent_s, command) in commands.items():
        seen_s, pose = poses.get(vehicle, (np.empty(0), np.empty((0, 3))))
        seen_s, first = np.unique(seen_s, return_index=True)
        pose = pose[first]
        tracks.append(Track(run, vehicle, sent_s, command, interpolate_poses(seen_s, pose, sent_s, longest_gap_s)))
    return tracks


def cut_into_runs(tracks: Sequence[Track], run_s: float) -> list[Track]:
    """Cut tracks of one run into runs of a length, all at the same times; a piece of a single row is left out."""
    if not tracks:
        return []
    begun_s = min(float(track.time_s[0]) for track in tracks)
    pieces = []
    for track in tracks:
        number = ((track.time_s - begun_s) // run_s).astype(int)
        for one in np.unique(number):
            rows = number == one
            if rows.sum() > 1:
                name = f"run_{one + 1:03}"
                pieces.append(Track(name, track.vehicle, track.time_s[rows], track.command[rows], track.pose[rows]))
    return sorted(pieces, key=lambda piece: piece.run)
