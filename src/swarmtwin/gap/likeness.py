"""The reference as it would be if it were driven as another session was: other commands are no gap."""

import numpy as np
from scipy.spatial import cKDTree

from swarmtwin.gap.session import Session

NEIGHBOURS = 5


def likeness(session: Session, known: Session) -> np.ndarray:
    """Return (N of known,) how often a transition of the reference is like one of the session: by its commands.

    With these weights the reference stands for what it would show if it were driven as the session was.
    """
    robot = known.drive.robot
    size = np.tile(robot.command_high - robot.command_low, 2)

    def commands(of: Session) -> np.ndarray:
        return np.concatenate([of.transitions.command, of.transitions.previous_command], axis=1) / size

    count = min(NEIGHBOURS, len(known))
    _, nearest = cKDTree(commands(known)).query(commands(session), k=np.arange(1, count + 1))
    return np.bincount(nearest.ravel(), minlength=len(known)) / count
