"""The poses of a recording in the order in which a stand-in drove them."""

import numpy as np

from swarmtwin.recordings.recording import Recording
from swarmtwin.standin.session import DrivenSession


def recorded_poses(driven: DrivenSession, recording: Recording) -> np.ndarray:
    """Return the poses (R, T + 1, V, 3) of a recorded session, NaN where there is none."""
    measured = np.full(driven.pose.shape, np.nan)
    runs = {run: number for number, run in enumerate(dict.fromkeys(track.run for track in recording.tracks))}
    for track in recording.tracks:
        measured[runs[track.run], : len(track), driven.session.vehicles.index(track.vehicle)] = track.pose
    return measured
