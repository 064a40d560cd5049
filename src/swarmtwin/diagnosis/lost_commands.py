"""A session in which commands may be lost: which of them arrived is summed over, from the start of each run.

A course says how old the command in force is, and how old that of the period before was. Courses are numbered so that
those of older commands come later: 0 both arrived; 1 the present one, and not the one before; 2 only the one before; 3
neither; and for each age k of 3 and more, 2 k − 2 the present one after one that was k − 1 old, and 2 k − 1 one that is
k old. The oldest that are followed stand for all older ones.
"""

from collections.abc import Sequence
from functools import cached_property
from typing import NamedTuple

import numpy as np
from scipy import special
from torch import Tensor

from swarmtwin.compiled import compiled
from swarmtwin.diagnosis.noise import log_density
from swarmtwin.diagnosis.session_errors import SessionErrors
from swarmtwin.diagnosis.session_prediction import arrival_probability
from swarmtwin.simulation.mechanism import Mechanism


class Ages(NamedTuple):
    """How old commands in force are followed, and with what probability they are so old.

    Attributes:
        arrives: probability that a command arrives.
        oldest: K ≥ 2 periods, which stand for all that are older.
    """

    arrives: float
    oldest: int

    @classmethod
    def of(cls, model: SessionErrors, mechanisms: Sequence[Mechanism]) -> "Ages":
        """Follow commands as far as a session's predictor does, however many are lost, so that no likelihood jumps."""
        arrives = min(max(arrival_probability(mechanisms), 1e-9), 1 - 1e-9)
        return cls(arrives, model.predictor.oldest_followed)

    @property
    def after_arrival(self) -> np.ndarray:
        """(K + 1,) the course in which the present command arrives after one of each age."""
        age = np.minimum(np.arange(self.oldest + 1), self.oldest - 1)
        return np.where(age < 2, age, 2 * age)

    @property
    def after_loss(self) -> np.ndarray:
        """(K + 1,) the course in which a command of each age goes on; 0 where none does, at age 0."""
        age = np.arange(self.oldest + 1)
        return np.where(age < 3, np.array([0, 2, 3])[np.minimum(age, 2)], 2 * age - 1)

    @property
    def probability(self) -> np.ndarray:
        """(K + 1,) that the command in force is of each age."""
        lost = (1 - self.arrives) ** np.arange(self.oldest + 1)
        return np.append(lost[:-1] * self.arrives, lost[-1])

    @property
    def course_probability(self) -> np.ndarray:
        """(2 K,) of each course."""
        chance = np.zeros(2 * self.oldest)
        np.add.at(chance, self.after_arrival, self.arrives * self.probability)
        chance[self.after_loss[1:]] = self.probability[1:]
        return chance


class LostCommands:
    """What a session looks like by which commands arrived: a hidden Markov model of how old the one in force is.

    Args:
        model: of the session of N transitions.
        mechanisms: some of which lose commands.
        near: the same with nearly the same mechanisms: its likeliest courses are kept, and the errors of those that not
            one transition took; None: all is looked for.
        is_quick: whether how the others differ from those of `near` is asked of one member of the simulation alone.

    Attributes:
        likeliest: (N,) each transition's likeliest course.
        whitened: (N, 3) errors of that course.
    """

    def __init__(
        self,
        model: SessionErrors,
        mechanisms: Sequence[Mechanism],
        near: "LostCommands | None" = None,
        is_quick: bool = False,
    ) -> None:
        self._model, self._mechanisms, self._near = model, mechanisms, near
        self._ages = Ages.of(model, mechanisms)
        kept, courses = near.errors_of_rare if near else {}, range(2 * self._ages.oldest)
        self._twists = {one: self._twist(one, is_quick) for one in courses if one not in kept}
        errors = kept | {one: model.errors_of(twist) for one, twist in self._twists.items()}
        self._errors = np.stack([errors[one] for one in courses], axis=-1)
        self.expect(np.zeros((len(self._errors), 3)), np.zeros((len(self._errors), 3, 4)))

    def _twist(self, course: int, is_quick: bool) -> Tensor:
        """Return the measured twists (N, 3) of a course."""
        if not is_quick or self._near is None or self._model.members < 2:
            return self._model.predictor.course(self._mechanisms, course)
        now, before = (
            self._model.one_member.course(mechanisms, course)
            for mechanisms in (self._mechanisms, self._near._mechanisms)
        )
        return self._near._twists[course] + (now - before)

    def expect(self, effect_errors: np.ndarray, where_lost: np.ndarray) -> None:
        """Choose the likeliest courses anew, where random effects make errors.

        Args:
            effect_errors: (N, 3) these errors, where every command arrives.
            where_lost: (N, 3, 4) what is added to them in each course; those of older commands are as the second
                and the last of these.
        """
        of_older = [where_lost[..., [1, 3]]] * (self._ages.oldest - 2)
        where_lost = np.concatenate([where_lost, *of_older], axis=-1)
        errors = self._errors - where_lost
        each = np.arange(len(errors))
        if self._near is None:
            self._density = _density_of_courses(self._model, errors - effect_errors[..., None], self._ages)
            self.likeliest = self._density.argmax(axis=1)
        else:
            self.likeliest = self._near.likeliest
        chosen = errors[each, :, self.likeliest]
        history = np.repeat(chosen[..., None], errors.shape[-1], axis=-1)
        self._courses = self._model.filter.with_history(errors, history)
        self.whitened = self._courses[each, :, self.likeliest]

    @cached_property
    def errors_of_rare(self) -> dict[int, np.ndarray]:
        """The errors (N, 3) of each course that less than one transition is expected to have taken."""
        if self._near is not None:
            return self._near.errors_of_rare
        taken = special.softmax(self._density, axis=1).sum(axis=0)
        return {int(course): self._errors[..., course] for course in np.flatnonzero(taken < 1.0)}

    def log_density(self, shift: np.ndarray, scale: np.ndarray) -> np.ndarray:
        """Return (N,) log densities, each given the transitions before it in its run.

        Args:
            shift: (N, 3) what random effects make of whitened errors.
            scale: (3,) spread of what is left.
        """
        left = (self._courses - shift[..., None]) / scale[:, None]
        emitted = log_density(left.transpose(0, 2, 1), self._model.noise.degrees_of_freedom)
        chains = self._model.filter.chains
        density: np.ndarray = _log_density(*chains, emitted, *_tables(self._ages))
        return density


def _tables(ages: Ages) -> tuple[float, np.ndarray, np.ndarray, np.ndarray]:
    return ages.arrives, ages.probability, ages.after_arrival, ages.after_loss


@compiled
def _log_density(
    rows: np.ndarray,
    ends: np.ndarray,
    emitted: np.ndarray,
    arrives: float,
    probability: np.ndarray,
    after_arrival: np.ndarray,
    after_loss: np.ndarray,
) -> np.ndarray:
    """Return (N,) log densities in chains of transitions, from (N, 2 K) of each course: Rabiner's forward algorithm.

    The hidden state is how old the command in force is, 0 to K periods, each scaled to sum to 1.
    """
    lost, oldest, density = 1 - arrives, len(probability) - 1, np.zeros(len(emitted))
    for chain in range(len(ends) - 1):
        age = probability.copy()
        for row in rows[ends[chain] : ends[chain + 1]]:
            largest = emitted[row].max()
            seen = np.exp(emitted[row] - largest)
            after = np.zeros(oldest + 1)
            for before in range(oldest + 1):
                after[0] += arrives * age[before] * seen[after_arrival[before]]
                older = min(before + 1, oldest)
                after[older] += lost * age[before] * seen[after_loss[older]]
            total = max(after.sum(), 1e-300)
            density[row] = np.log(total) + largest
            age = after / total
    return density


def likeliest_errors(model: SessionErrors, mechanisms: Sequence[Mechanism]) -> np.ndarray:
    """Return the errors (N, 3) of each transition's likeliest course, by the reference's noise."""
    ages = Ages.of(model, mechanisms)
    twists = (model.predictor.course(mechanisms, course) for course in range(2 * ages.oldest))
    errors = np.stack([model.errors_of(twist) for twist in twists], axis=-1)
    return errors[np.arange(len(errors)), :, _density_of_courses(model, errors, ages).argmax(axis=1)]


def _density_of_courses(model: SessionErrors, errors: np.ndarray, ages: Ages) -> np.ndarray:
    """Return (N, 2 K) the log of how probable each course is and errors (N, 3, 2 K) are in it, of each by itself."""
    chance = np.log(ages.course_probability)
    spread, freedom = model.usual_spread[..., None], model.reference_noise.degrees_of_freedom
    alone: np.ndarray = log_density((errors / spread).transpose(0, 2, 1), freedom) + chance
    return alone
