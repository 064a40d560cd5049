"""What a diagnosis leaves in memory: its words, the extended simulation, and what pictures are drawn of."""

from dataclasses import dataclass

import numpy as np

from swarmtwin.dynamics.base import Dynamics
from swarmtwin.dynamics.open_loop import OpenLoop
from swarmtwin.gap.diagnosis import Diagnosis
from swarmtwin.transitions import Transitions


@dataclass(frozen=True)
class Finding:
    """A finished diagnosis.

    Attributes:
        diagnosis: what it says.
        simulation: the simulation that was examined.
        extended: the simulation with the mechanisms found, or with a learned residual; None where nothing is wrong.
        transitions: the N measured transitions that were looked at.
        held_out: (N,) those that nothing was fitted to.
        residual_before: (N, 3) measured minus simulated displacement (forward, left, turn), each divided by the
            reference's own noise there: about 1 in size where nothing is wrong.
        residual_after: (N, 3) likewise, of the extended simulation; the same array where there is none.
        runs_before: held-out runs predicted open loop by the simulation.
        runs_after: the same runs predicted by the extended simulation.
        drive: (P, m) commands that would separate rivals, None where that is not needed.
    """

    diagnosis: Diagnosis
    simulation: Dynamics
    extended: Dynamics | None
    transitions: Transitions
    held_out: np.ndarray
    residual_before: np.ndarray
    residual_after: np.ndarray
    runs_before: tuple[OpenLoop, ...]
    runs_after: tuple[OpenLoop, ...]
    drive: np.ndarray | None
