"""Measured transitions as a diagnosis works on them."""

from dataclasses import dataclass, replace
from typing import Self

import numpy as np
import torch
from torch import Tensor

from swarmtwin.dynamics.twist import twist_of
from swarmtwin.gap.mechanism import Drive
from swarmtwin.gap.surroundings import Surroundings
from swarmtwin.transitions import Transitions

SAME_TIME_S = 2e-3


@dataclass(frozen=True)
class Session:
    """N measured transitions whose previous command is known.

    Attributes:
        transitions: what was measured.
        drive: the situations, float64.
        way: (N, 3) measured ways along an arc: forward_mm, left_mm, turn_rad.
        run: (N,) numbers from 0 in order of time: the blocks of every statistic.
        follows: (N,) index of the transition just before, of the same vehicle and run; −1 where there is none.
        turned: (N,) angle in rad from the middle of that transition to the middle of this one, 0 where there is none.
    """

    transitions: Transitions
    drive: Drive
    way: Tensor
    run: np.ndarray
    follows: np.ndarray
    turned: Tensor

    @classmethod
    def of(cls, transitions: Transitions, surroundings: Surroundings) -> Self:
        """Take the transitions whose previous command is known."""
        known = transitions.where(np.isfinite(transitions.previous_command).all(axis=1))
        way = twist_of(torch.as_tensor(known.displacement))
        drive = Drive(
            robot=known.robot,
            surroundings=surroundings,
            command=torch.as_tensor(known.command),
            previous_command=torch.as_tensor(known.previous_command),
            earlier_command=torch.as_tensor(_earlier(known)),
            pose=torch.as_tensor(known.pose),
            elapsed_s=torch.as_tensor(known.time_s),
            duration_s=torch.as_tensor(known.duration_s),
            neighbours=torch.as_tensor(known.neighbours),
        )
        follows = _follows(known)
        before = way[np.maximum(follows, 0), 2]
        turned = torch.where(torch.as_tensor(follows >= 0), (before + way[:, 2]) / 2, torch.zeros(len(way)))
        _, run = np.unique(known.run, return_inverse=True)
        return cls(known, drive, way, run, follows, turned.double())

    def __len__(self) -> int:
        return len(self.way)

    @property
    def runs(self) -> int:
        """Number of runs."""
        return int(self.run.max()) + 1 if len(self.run) else 0

    def where(self, chosen: np.ndarray) -> "Session":
        """Return the transitions chosen by a mask (N,)."""
        return Session.of(self.transitions.where(chosen), self.drive.surroundings)

    def within(self, surroundings: Surroundings) -> "Session":
        """Return the same transitions in other surroundings."""
        return replace(self, drive=replace(self.drive, surroundings=surroundings))

    def by_run(self, values: np.ndarray) -> np.ndarray:
        """Sum values (N, ...) over the transitions of each run, (R, ...)."""
        total = np.zeros((self.runs, *values.shape[1:]))
        np.add.at(total, self.run, values)
        return total


def _earlier(transitions: Transitions) -> np.ndarray:
    """Return (N, m) the command before the previous one, the previous one where that is not known."""
    return np.where(np.isfinite(transitions.earlier_command), transitions.earlier_command, transitions.previous_command)


def _follows(transitions: Transitions) -> np.ndarray:
    end_s = transitions.time_s + transitions.duration_s
    same = (transitions.run[1:] == transitions.run[:-1]) & (transitions.vehicle[1:] == transitions.vehicle[:-1])
    same &= np.abs(transitions.time_s[1:] - end_s[:-1]) < SAME_TIME_S
    follows = np.full(len(transitions), -1)
    follows[1:][same] = np.flatnonzero(same)
    return follows
