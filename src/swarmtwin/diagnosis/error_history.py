"""What errors depend on that came before them: whatever lasts, drifts or sways leaves errors that follow each other.

Where the simulation and its causes are right, whitened errors are independent of all earlier ones. A current that
turns, a load that came off, a loose camera make the next error like the last ones: in the vehicle's frame, in the
room's, or in proportion to the motion. No form of the gap has to be guessed for that.
"""

import numpy as np
from scipy.signal import lfilter

from swarmtwin.diagnosis.cross_fitted_ridge import CrossFittedRidge
from swarmtwin.diagnosis.likelihood import FittedMechanisms, SessionLikelihood
from swarmtwin.diagnosis.noise import log_density
from swarmtwin.geometry import rotate


def nats_by_history(model: SessionLikelihood, fitted: FittedMechanisms) -> float:
    """Return the nats by which errors are likelier, each given those before it, than on their own.

    A ridge regression on running means of earlier errors, cross-fitted over runs: what is predicted of a run is
    predicted by coefficients that have not seen it, from errors that came before. None is below 0: what lasts makes
    errors alike, while errors of opposite sign say that the camera's noise is another one than was thought.

    Args:
        model: of N transitions.
        fitted: mechanisms, and the errors that they leave.
    """
    left, settings = fitted.residual / fitted.scale, model.settings.flexible
    target, predicted = np.clip(left, -settings.clip_z, settings.clip_z), np.zeros_like(left)
    for axis, columns in enumerate(running_means(model, target)):
        ridge = CrossFittedRidge(columns, model.weight, model.flexible.fold, settings.ridges)
        (predicted[:, axis],) = ridge.answers(target[:, axis], positive=True)
    before, after = (log_density(one, model.noise.degrees_of_freedom) for one in (left, left - predicted))
    return float((after - before).sum())


def running_means(model: SessionLikelihood, errors: np.ndarray) -> list[np.ndarray]:
    """Return for each axis functions (N, q) of the whitened errors (N, 3) before each transition of its vehicle.

    They are running means over some numbers of transitions, across runs, of unit variance where errors are independent:
    of the errors in the room's frame, and in the vehicle's as they go with its motion. Errors under the command that
    still holds are not among them, and the means fade meanwhile: what the simulation gets wrong of a command it gets
    wrong again.
    """
    transitions, motion = model.session.transitions, model.motion
    order = np.lexsort((transitions.time_s, transitions.vehicle))
    begins = np.flatnonzero(np.diff(transitions.vehicle[order], prepend=-1))
    held = model.session.held[order]
    size = motion[:, [0, 2]] / np.maximum(np.sqrt((motion[:, [0, 2]] ** 2).mean(axis=0)), 1e-9)
    along = np.column_stack([np.ones(len(size)), size])
    spread = model.noise.spread(motion)[:, :2]
    usual = np.sqrt((spread**2).mean())
    heading = transitions.pose[:, 2] + transitions.displacement[:, 2]
    in_room = rotate(errors[:, :2] * spread / usual, heading)
    with_motion = errors[:, :, None] * along[:, None, :]
    columns: list[list[np.ndarray]] = [[], [], []]
    for transitions_back in model.settings.flexible.running_means:
        fade = float(np.exp(-1 / transitions_back))
        room, moving = (_running_mean(one, order, begins, held, fade) for one in (in_room, with_motion))
        room = rotate(room, -heading) * usual / spread
        moving = moving * along[:, None, :]
        for axis in range(3):
            columns[axis] += [*moving[:, axis].T, *(room[:, [axis]].T if axis < 2 else ())]
    return [np.clip(np.column_stack(own), -15.0, 15.0) for own in columns]


def _running_mean(
    values: np.ndarray, order: np.ndarray, begins: np.ndarray, held: np.ndarray, fade: float
) -> np.ndarray:
    """Return exponentially fading means of the values (N, ...) before each, in an order that begins anew at places.

    Of these the last `held` (N,), given in the order, are left out.
    """
    means = np.empty_like(values)
    for rows in np.split(order, begins[1:]):
        means[rows] = lfilter([0.0, fade], [1.0, -fade], values[rows], axis=0)
    ordered = means[order][np.arange(len(order)) - held]
    means[order] = ordered * (fade ** held.astype(float)).reshape(-1, *([1] * (values.ndim - 1)))
    means *= np.sqrt(1 - fade**2) / fade
    return means
