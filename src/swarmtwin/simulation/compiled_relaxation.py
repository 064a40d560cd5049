"""Twists that go gradually to others, in one pass over arrays; see `relaxation`."""

import numpy as np

from swarmtwin.compiled import compiled


@compiled
def relaxed_twist(
    start: np.ndarray,
    target: np.ndarray,
    on_average: np.ndarray,
    left: np.ndarray,
    of_turn: np.ndarray,
    of_others: np.ndarray,
    mixed: np.ndarray,
) -> tuple[np.ndarray, np.ndarray]:
    """Return what `relaxation.relaxed_twist` says, (N, 3) each: the mean twist and that at the end.

    Args:
        start: (N, 3) twists at first.
        target: (N, 3) in the long run.
        on_average: (3,) what is left of a change, on average.
        left: (3,) likewise at last.
        of_turn: (2,) what the other axis' target counts for beside what is left of the turn, ahead and aside.
        of_others: (2,) what is left of the other axis counts for beside the turn's target.
        mixed: (2,) likewise beside what is left of the turn.
    """
    mean, end = np.empty_like(target), np.empty_like(target)
    for row in range(len(target)):
        for axis in range(3):
            late = start[row, axis] - target[row, axis]
            mean[row, axis] = target[row, axis] + late * on_average[axis]
            end[row, axis] = target[row, axis] + late * left[axis]
        turn, late_turn = target[row, 2], start[row, 2] - target[row, 2]
        for axis in range(2):
            other = 1 - axis
            late = start[row, other] - target[row, other]
            mean[row, axis] += late_turn * (of_turn[axis] * target[row, other] + mixed[axis] * late)
            mean[row, axis] -= turn * of_others[axis] * late
    return mean, end
