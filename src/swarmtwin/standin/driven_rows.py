"""What was driven, row by row, as the physics takes it."""

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from swarmtwin.standin.physics import Period, others_in_run
from swarmtwin.standin.session import DrivenSession


@dataclass(frozen=True)
class DrivenRows:
    """N driven rows of one vehicle, as the physics takes them; ... is (N, 1).

    Attributes:
        state: (states, ...) true states.
        command: (m, ...) as sent.
        active_command: (m, ...) that held before.
        duration_s: (...) true lengths of the periods.
        progress: (...) share of the session that has passed when they begin.
        progress_after: (...) when they end.
        others: (2, 2, others, ...) x and y of the neighbours at start and end.
    """

    state: np.ndarray
    command: np.ndarray
    active_command: np.ndarray
    duration_s: np.ndarray
    progress: np.ndarray
    progress_after: np.ndarray
    others: np.ndarray

    @classmethod
    def of(cls, driven: DrivenSession, vehicle: int) -> "DrivenRows":
        """Take the rows of one vehicle, in order of run and time."""
        others = np.stack([others_in_run(coordinate)[..., vehicle] for coordinate in driven.state[:2]])
        return cls(
            _flat(driven.state[:, :, :-1, vehicle]),
            _flat(np.moveaxis(driven.command[:, :, vehicle], -1, 0)),
            _flat(driven.active_command[:, :, :-1, vehicle]),
            _flat(driven.duration_s),
            _flat(driven.session.progress(driven.time_s[:, :-1])),
            _flat(driven.session.progress(driven.time_s[:, 1:])),
            _flat(np.stack([others[..., :-1], others[..., 1:]])),
        )

    def at(self, rows: np.ndarray | slice) -> "DrivenRows":
        """Return some of the rows, in single precision."""
        return DrivenRows(*(value[..., rows, :].astype(np.float32) for value in vars(self).values()))

    def chunks(self, draws: int) -> Iterator[tuple[slice, "DrivenRows"]]:
        """Cut the rows into parts that, `draws` times each, fit the processor's cache."""
        size = max(16_384 // draws, 1)
        for first in range(0, self.duration_s.shape[0], size):
            part = slice(first, first + size)
            yield part, self.at(part)

    def period(self, command: np.ndarray, previous_command: np.ndarray) -> Period:
        """Return the rows' periods with other commands in them."""
        return Period(command, previous_command, self.duration_s, self.progress, self.others)


def _flat(values: np.ndarray) -> np.ndarray:
    """Turn (..., R, T) into (..., R · T, 1)."""
    return values.reshape(*values.shape[:-2], values.shape[-2] * values.shape[-1], 1)
