"""The filter that makes a session's errors independent of each other; `noise.py` says of what they are made.

What is known of the camera's error passes from each transition to the one that follows: compiled loops over chains of
transitions, which cost the same for each transition however long the chains are.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple, Self

import numpy as np

from swarmtwin.compiled import compiled


class Chains(NamedTuple):
    """Transitions that follow one another.

    Attributes:
        rows: (N,) indices of transitions, chain by chain.
        ends: (C + 1,) where in these each chain begins, and where the last one ends.
    """

    rows: np.ndarray
    ends: np.ndarray

    @classmethod
    def of(cls, chains: Sequence[np.ndarray]) -> Self:
        """Take the rows of each chain."""
        ends = np.cumsum([0, *(len(chain) for chain in chains)])
        return cls(np.concatenate([np.zeros(0, np.int64), *chains]), ends)

    def alone(self) -> "Chains":
        """Return them of their own rows alone, in their order."""
        return Chains(np.arange(len(self.rows)), self.ends)


@dataclass(frozen=True)
class NoiseFilter:
    """Makes the errors of one session independent, with unit covariance; a linear map.

    Attributes:
        chains: of the transitions.
        carry: (N, 3, 3) what the camera's error before a period does to its error, −A.
        whiten: (N, 3, 3) standardises innovations, lower triangular.
        gain: (N, 3, 3) what an innovation says of the camera's error after it.
        log_volume: (N,) log determinant of the innovation's standard deviation.
    """

    chains: Chains
    carry: np.ndarray
    whiten: np.ndarray
    gain: np.ndarray
    log_volume: np.ndarray

    @classmethod
    def prepared(cls, chains: Chains, carry: np.ndarray, motion: np.ndarray, variance: np.ndarray) -> Self:
        """Run the filter's covariances through chains.

        Args:
            chains: as the attribute.
            carry: likewise.
            motion: (N, 3, 3) covariances of the motion's own part.
            variance: (3,) of a measured pose.
        """
        return cls(chains, carry, *_covariances(*chains, carry, np.ascontiguousarray(motion), variance))

    def __call__(self, errors: np.ndarray) -> np.ndarray:
        """Return columns of errors (N, 3, k), or of their changes, independent and of unit covariance."""
        return self.with_history(errors, errors)

    def with_history(self, errors: np.ndarray, history: np.ndarray) -> np.ndarray:
        """Standardise errors (N, 3, k) given that those before them were `history` (N, 3, k)."""
        given = (np.ascontiguousarray(one) for one in (errors, history))
        whitened: np.ndarray = _whitened(*self.chains, self.carry, self.whiten, self.gain, *given)
        return whitened

    def inverse(self, whitened: np.ndarray) -> np.ndarray:
        """Return the errors (N, 3) that become `whitened` (N, 3)."""
        errors: np.ndarray = _errors(*self.chains, self.carry, self.whiten, self.gain, np.ascontiguousarray(whitened))
        return errors


@compiled
def _covariances(
    rows: np.ndarray, ends: np.ndarray, carry: np.ndarray, motion: np.ndarray, variance: np.ndarray
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return whiten, gain and log_volume of a filter."""
    whiten, gain, log_volume = np.zeros_like(carry), np.zeros_like(carry), np.zeros(len(carry))
    known, before, spread, root = np.empty((3, 3)), np.empty((3, 3)), np.empty((3, 3)), np.empty((3, 3))
    for chain in range(len(ends) - 1):
        known[:] = np.diag(variance)
        for row in rows[ends[chain] : ends[chain + 1]]:
            for i in range(3):
                for j in range(3):
                    before[i, j] = (
                        carry[row, i, 0] * known[0, j] + carry[row, i, 1] * known[1, j] + carry[row, i, 2] * known[2, j]
                    )
            for i in range(3):
                for j in range(3):
                    spread[i, j] = motion[row, i, j] + (
                        before[i, 0] * carry[row, j, 0]
                        + before[i, 1] * carry[row, j, 1]
                        + before[i, 2] * carry[row, j, 2]
                    )
                spread[i, i] += variance[i]
            root[0, 0] = np.sqrt(spread[0, 0])
            root[1, 0], root[2, 0] = spread[1, 0] / root[0, 0], spread[2, 0] / root[0, 0]
            root[1, 1] = np.sqrt(spread[1, 1] - root[1, 0] ** 2)
            root[2, 1] = (spread[2, 1] - root[2, 0] * root[1, 0]) / root[1, 1]
            root[2, 2] = np.sqrt(spread[2, 2] - root[2, 0] ** 2 - root[2, 1] ** 2)
            log_volume[row] = np.log(root[0, 0]) + np.log(root[1, 1]) + np.log(root[2, 2])
            inverse = whiten[row]
            for i in range(3):
                inverse[i, i] = 1 / root[i, i]
            inverse[1, 0] = -root[1, 0] * inverse[0, 0] * inverse[1, 1]
            inverse[2, 1] = -root[2, 1] * inverse[1, 1] * inverse[2, 2]
            inverse[2, 0] = -(root[2, 0] * inverse[0, 0] + root[2, 1] * inverse[1, 0]) * inverse[2, 2]
            for i in range(3):
                for j in range(3):
                    gain[row, i, j] = variance[i] * (
                        inverse[0, i] * inverse[0, j] + inverse[1, i] * inverse[1, j] + inverse[2, i] * inverse[2, j]
                    )
            for i in range(3):
                for j in range(3):
                    known[i, j] = -gain[row, i, j] * variance[j]
                known[i, i] += variance[i]
    return whiten, gain, log_volume


@compiled
def _whitened(
    rows: np.ndarray,
    ends: np.ndarray,
    carry: np.ndarray,
    whiten: np.ndarray,
    gain: np.ndarray,
    errors: np.ndarray,
    history: np.ndarray,
) -> np.ndarray:
    """Return errors (N, 3, k), standardised given that those before them were `history` (N, 3, k)."""
    columns = errors.shape[2]
    whitened = np.zeros_like(errors)
    expected, shift = np.empty((3, columns)), np.empty((3, columns))
    for chain in range(len(ends) - 1):
        expected[:] = 0.0
        for row in rows[ends[chain] : ends[chain + 1]]:
            before, standard, said = carry[row], whiten[row], gain[row]
            error, known, result = errors[row], history[row], whitened[row]
            for k in range(columns):
                for i in range(3):
                    shift[i, k] = (
                        before[i, 0] * expected[0, k] + before[i, 1] * expected[1, k] + before[i, 2] * expected[2, k]
                    )
            for k in range(columns):
                x, y, turn = error[0, k] - shift[0, k], error[1, k] - shift[1, k], error[2, k] - shift[2, k]
                for i in range(3):
                    result[i, k] = standard[i, 0] * x + standard[i, 1] * y + standard[i, 2] * turn
                x, y, turn = known[0, k] - shift[0, k], known[1, k] - shift[1, k], known[2, k] - shift[2, k]
                for i in range(3):
                    expected[i, k] = said[i, 0] * x + said[i, 1] * y + said[i, 2] * turn
    return whitened


@compiled
def _errors(
    rows: np.ndarray,
    ends: np.ndarray,
    carry: np.ndarray,
    whiten: np.ndarray,
    gain: np.ndarray,
    whitened: np.ndarray,
) -> np.ndarray:
    """Return the errors (N, 3) that a filter standardises to `whitened` (N, 3)."""
    errors = np.zeros_like(whitened)
    expected = np.empty(3)
    for chain in range(len(ends) - 1):
        expected[:] = 0.0
        for row in rows[ends[chain] : ends[chain + 1]]:
            before, standard, said = carry[row], whiten[row], gain[row]
            x = whitened[row, 0] / standard[0, 0]
            y = (whitened[row, 1] - standard[1, 0] * x) / standard[1, 1]
            turn = (whitened[row, 2] - standard[2, 0] * x - standard[2, 1] * y) / standard[2, 2]
            for i in range(3):
                errors[row, i] = before[i, 0] * expected[0] + before[i, 1] * expected[1] + before[i, 2] * expected[2]
            for i in range(3):
                expected[i] = said[i, 0] * x + said[i, 1] * y + said[i, 2] * turn
            errors[row, 0] += x
            errors[row, 1] += y
            errors[row, 2] += turn
    return errors
