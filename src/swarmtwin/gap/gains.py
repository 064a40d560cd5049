"""How much smaller errors are with an extension than without, on runs that nothing was fitted to."""

import numpy as np

from swarmtwin.dynamics.base import Dynamics
from swarmtwin.dynamics.evaluation import predict
from swarmtwin.dynamics.open_loop import OpenLoop
from swarmtwin.gap.diagnosis import Gain, Gains
from swarmtwin.geometry import orientation_error_rad, position_error_mm
from swarmtwin.transitions import Transitions

DRAWS = 1000


def one_step_errors(dynamics: Dynamics, transitions: Transitions) -> np.ndarray:
    """Return (N, 2) position errors in mm and orientation errors in degrees."""
    predicted = predict(dynamics, transitions)
    measured = transitions.displacement
    return np.column_stack(
        [position_error_mm(predicted, measured), np.degrees(orientation_error_rad(predicted, measured))]
    )


def gains(
    before: np.ndarray,
    after: np.ndarray,
    run: np.ndarray,
    loops_before: tuple[OpenLoop, ...],
    loops_after: tuple[OpenLoop, ...],
    rng: np.random.Generator,
) -> Gains:
    """Compare one-step errors (N, 2) of transitions in runs (N,), and open-loop errors of tracks."""
    position, orientation = (_gain(before[:, axis], after[:, axis], run, rng) for axis in (0, 1))
    names = sorted({loop.track.run for loop in loops_before})
    loop_run = np.array([names.index(loop.track.run) for loop in loops_before], dtype=int)
    first, second = (np.array([loop.rmse_mm for loop in loops]) for loops in (loops_before, loops_after))
    known = np.isfinite(first) & np.isfinite(second)
    return Gains(
        position_mm=position,
        orientation_deg=orientation,
        open_loop_mm=_gain(first[known], second[known], loop_run[known], rng),
    )


def _gain(before: np.ndarray, after: np.ndarray, run: np.ndarray, rng: np.random.Generator) -> Gain:
    if not len(before):
        return Gain(before=0.0, after=0.0, low=0.0, high=0.0)
    _, run = np.unique(run, return_inverse=True)
    sums = np.zeros((int(run.max()) + 1, 2))
    np.add.at(sums, run, np.column_stack([before - after, np.ones(len(before))]))
    weights = rng.multinomial(len(sums), np.full(len(sums), 1 / len(sums)), DRAWS)
    drawn = weights @ sums
    low, high = np.quantile(drawn[:, 0] / np.maximum(drawn[:, 1], 1), [0.025, 0.975])
    return Gain(before=float(before.mean()), after=float(after.mean()), low=float(low), high=float(high))
