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
        self._arrives = _arrival_probability(mechanisms)
        self._errors = _errors_of_courses(model, mechanisms)
        self.expect(np.zeros((len(self._errors), 3)), np.zeros_like(self._errors))

    def expect(self, effect_errors: np.ndarray, where_lost: np.ndarray) -> None:
        """Choose the likeliest courses anew, where random effects make errors.

        Args:
            effect_errors: (N, 3) these errors, where every command arrives.
            where_lost: (N, 3, 4) what is added to them in each course.
        """
        errors = self._errors - where_lost
        each = np.arange(len(errors))
        self.likeliest = _likeliest(self._model, errors - effect_errors[..., None], self._arrives)
        chosen = errors[each, :, self.likeliest]
        history = np.repeat(chosen[..., None], errors.shape[-1], axis=-1)
        self._courses = self._model.filter.with_history(errors, history)
        self.whitened = self._courses[each, :, self.likeliest]

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
    errors = _errors_of_courses(model, mechanisms)
    return errors[np.arange(len(errors)), :, _likeliest(model, errors, _arrival_probability(mechanisms))]


def _arrival_probability(mechanisms: Sequence[Mechanism]) -> float:
    return min(max(arrival_probability(mechanisms), 1e-9), 1 - 1e-9)


def _errors_of_courses(model: SessionErrors, mechanisms: Sequence[Mechanism]) -> np.ndarray:
    """Return errors (N, 3, 4) by which commands arrived: both, the last one, the one before, neither."""
    return np.stack([model.errors_of(twist) for twist in model.predictor.outcomes(mechanisms)], axis=-1)


def _likeliest(model: SessionErrors, errors: np.ndarray, arrives: float) -> np.ndarray:
    """Return (N,) which of the courses with errors (N, 3, 4) each transition most likely took."""
    lost = 1 - arrives
    chance = np.log([arrives * arrives, arrives * lost, arrives * lost, lost**2])
    noise = model.reference_noise
    spread = noise.spread(model.simulated.numpy())[..., None]
    alone = log_density((errors / spread).transpose(0, 2, 1), noise.degrees_of_freedom) + chance
    likeliest: np.ndarray = alone.argmax(axis=1)
    return likeliest
