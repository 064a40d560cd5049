"""A session in which commands may be lost: which of them arrived is summed over, from the start of each run."""

from collections.abc import Sequence

import numpy as np

from swarmtwin.compiled import compiled
from swarmtwin.diagnosis.noise import log_density
from swarmtwin.diagnosis.session_errors import SessionErrors
from swarmtwin.diagnosis.session_prediction import arrival_probability
from swarmtwin.simulation.mechanism import Mechanism


class LostCommands:
    """What a session looks like by which commands arrived: a hidden Markov model of how old the one in force is.

    Args:
        model: of the session of N transitions.
        mechanisms: some of which lose commands.
        courses: (N,) taken for the likeliest ones; None: these are looked for.

    Attributes:
        likeliest: (N,) each transition's likeliest course, 0 where both its commands arrived.
        whitened: (N, 3) errors of that course.
    """

    def __init__(
        self, model: SessionErrors, mechanisms: Sequence[Mechanism], courses: np.ndarray | None = None
    ) -> None:
        self._model, self._taken = model, courses
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
        if self._taken is None:
            self.likeliest = _likeliest(self._model, errors - effect_errors[..., None], self._arrives)
        else:
            self.likeliest = self._taken
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
        chains = self._model.filter.chains
        density: np.ndarray = _log_density(*chains, emitted, self._arrives)
        return density


@compiled
def _log_density(rows: np.ndarray, ends: np.ndarray, emitted: np.ndarray, arrives: float) -> np.ndarray:
    """Return (N,) log densities in chains of transitions, of those (N, 4) of each course: Rabiner's forward algorithm.

    The hidden state is how old the command in force is: none, one or more periods, each scaled to sum to 1.
    """
    lost, density = 1 - arrives, np.zeros(len(emitted))
    for chain in range(len(ends) - 1):
        now, once, twice = arrives, arrives * lost, lost**2
        for row in rows[ends[chain] : ends[chain + 1]]:
            largest = emitted[row].max()
            seen = np.exp(emitted[row] - largest)
            older = once + twice
            fresh = arrives * (now * seen[0] + older * seen[1])
            once = lost * now * seen[2]
            twice = lost * older * seen[3]
            total = max(fresh + once + twice, 1e-300)
            density[row] = np.log(total) + largest
            now, once, twice = fresh / total, once / total, twice / total
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
    spread, freedom = model.usual_spread[..., None], model.reference_noise.degrees_of_freedom
    alone = log_density((errors / spread).transpose(0, 2, 1), freedom) + chance
    likeliest: np.ndarray = alone.argmax(axis=1)
    return likeliest
