"""What a session says of the traction at each place, before any mechanism is fitted."""

from typing import NamedTuple

import numpy as np


class LocalTractionScore(NamedTuple):
    """Where in the arena a loss of traction would explain residuals: where a search for a patch begins.

    Attributes:
        position: (N, 2) mm, the middle of each transition.
        slope: (N,) derivative of each one's log-likelihood with respect to a loss of traction there.
        curvature: (N,) how fast that derivative falls.
    """

    position: np.ndarray
    slope: np.ndarray
    curvature: np.ndarray
