"""A session in which commands may be lost: which of them arrived is summed over, from the start of each run."""

from collections.abc import Sequence

import numpy as np

from swarmtwin.diagnosis.noise import log_density
from swarmtwin.diagnosis.session_errors import SessionErrors
from swarmtwin.diagnosis.session_prediction import arrival_probability
from swarmtwin.simulation.mechanism import Mechanism


class LostCommands:
    """What a session looks like by which commands arrived: a hidden Markov model of how old the one in force is.

    Args:
        model: of the session of N transitions.
        mechanisms: some of which lose commands.

    Attributes:
        likeliest: (N,) each transition's likeliest course, 0 where both its commands arrived.
        whitened: (N, 3) errors of that course.
    """

    def __init__(self, model: SessionErrors, mechanisms: Sequence[Mechanism]) -> None:
        self._model = model
        self._arrives = min(max(arrival_probability(mechanisms), 1e-9), 1 - 1e-9)
        errors, self.likeliest = _courses(model, mechanisms)
        likeliest = self.likeliest
        chosen = errors[np.arange(len(errors)), :, likeliest]
        history = np.repeat(chosen[..., None], errors.shape[-1], axis=-1)
        self._courses = model.filter.with_history(errors, history)
        self.whitened = self._courses[np.arange(len(errors)), :, likeliest]

    def log_density(self, shift: np.ndarray, scale: np.ndarray) -> np.ndarray:
        """Return (N,) log densities, each given the transitions before it in its run.

        Args:
            shift: (N, 3) what random effects make of whitened errors.
            scale: (3,) spread of what is left.
        """
        left = (self._courses - shift[..., None]) / scale[:, None]
        emitted = log_density(left.transpose(0, 2, 1), self._model.noise.degrees_of_freedom)
        arrives, lost = self._arrives, 1 - self._arrives
        density = np.zeros(len(left))
        age = np.zeros((0, 3))
        for number, rows in enumerate(self._model.filter.steps):
            if not number:
                age = np.tile([arrives, arrives * lost, lost**2], (len(rows), 1))
            age = age[: len(rows)]
            largest = emitted[rows].max(axis=1, keepdims=True)
            seen = np.exp(emitted[rows] - largest)
            fresh = arrives * (age[:, 0] * seen[:, 0] + (age[:, 1] + age[:, 2]) * seen[:, 1])
            once = lost * age[:, 0] * seen[:, 2]
            twice = lost * (age[:, 1] + age[:, 2]) * seen[:, 3]
            total = np.maximum(fresh + once + twice, 1e-300)
            density[rows] = np.log(total) + largest[:, 0]
            age = np.column_stack([fresh, once, twice]) / total[:, None]
        return density


def likeliest_errors(model: SessionErrors, mechanisms: Sequence[Mechanism]) -> np.ndarray:
    """Return the errors (N, 3) of each transition's likeliest course, by the reference's noise."""
    errors, likeliest = _courses(model, mechanisms)
    return errors[np.arange(len(errors)), :, likeliest]


def _courses(model: SessionErrors, mechanisms: Sequence[Mechanism]) -> tuple[np.ndarray, np.ndarray]:
    """Return errors (N, 3, 4) by which commands arrived, and which course each transition most likely took, (N,)."""
    arrives = min(max(arrival_probability(mechanisms), 1e-9), 1 - 1e-9)
    lost = 1 - arrives
    errors = np.stack([model.errors_of(twist) for twist in model.predictor.outcomes(mechanisms)], axis=-1)
    chance = np.log([arrives * arrives, arrives * lost, arrives * lost, lost**2])
    noise = model.reference_noise
    spread = noise.spread(model.simulated.numpy())[..., None]
    alone = log_density((errors / spread).transpose(0, 2, 1), noise.degrees_of_freedom) + chance
    return errors, alone.argmax(axis=1)
