"""Step 4, its tool: a cause that grows from nothing in one parameter, and what a session shows of it."""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Self

import numpy as np

from swarmtwin.diagnosis.likelihood import MechanismClass, SessionLikelihood, arriving
from swarmtwin.diagnosis.random_effects import RandomEffects
from swarmtwin.diagnosis.screening import Candidate
from swarmtwin.simulation.mechanism import Mechanism, Parameter


@dataclass(frozen=True)
class SizedCause:
    """A mechanism whose size one parameter says, the others held.

    Attributes:
        kind: of the mechanism.
        name: of the parameter.
        parameter: that.
        held: values of the others.
        sign: the side to which it grows.
    """

    kind: MechanismClass
    name: str
    parameter: Parameter
    held: Mapping[str, float]
    sign: float

    @classmethod
    def of(cls, candidate: Candidate, model: SessionLikelihood) -> Self:
        """Take the first parameter in which a candidate is off where it does nothing; the others are as there."""
        name, off = next(iter(candidate.off.items()))
        parameters = candidate.form.parameters_of(model.robot, model.session.conditions)
        nulls = {key: one.null_value for key, one in parameters.items() if one.null_value is not None}
        return cls(candidate.form, name, parameters[name], {**candidate.held, **nulls}, math.copysign(1.0, off))

    @property
    def largest(self) -> float:
        """The largest size within the bounds."""
        assert self.parameter.null_value is not None
        end = self.parameter.high if self.sign > 0 else self.parameter.low
        return abs(end - self.parameter.null_value)

    def value(self, size: float) -> float:
        """Return the parameter at a size."""
        assert self.parameter.null_value is not None
        return self.parameter.null_value + self.sign * size

    def at(self, size: float) -> Mechanism:
        """Return the mechanism at a size."""
        return self.kind.at({**self.held, self.name: self.value(size)})


class Surroundings:
    """Causes that are there already, and products of what else would change, with all that is no gap integrated out.

    What the parameters of those causes would take over, were they fitted anew, counts to that.

    Args:
        model: of the session of N transitions.
        mechanisms: that are there, with values; commands that they may lose are not looked at.
        effects: what else is no gap; None: all of it.
    """

    def __init__(
        self, model: SessionLikelihood, mechanisms: Sequence[Mechanism], effects: RandomEffects | None = None
    ) -> None:
        self.model, effects = model, effects or model.effects
        self.arriving = arriving(mechanisms)
        self._here = model.whitened(self.arriving)
        self._slopes, precision = self.slopes(())
        prior = np.sqrt(np.diag(precision))
        self._effects = effects.extended(self._slopes / prior) if len(prior) else effects

    def change(self, mechanism: Mechanism) -> np.ndarray:
        """Return (3 N,) by what a mechanism changes whitened errors."""
        changed: np.ndarray = (
            self.model.whitened_near([*self.arriving, mechanism], self.arriving) - self._here
        ).ravel()
        return changed

    def gram(self, columns: np.ndarray) -> np.ndarray:
        """Return products (p, p) of columns (3 N, p) with each other."""
        return self._effects.gram(columns)

    def beyond(self, columns: np.ndarray) -> np.ndarray:
        """Return columns (3 N, p) less what is taken over: what their products are made with."""
        return self._effects.beyond(columns)

    def least_squares(self, columns: np.ndarray, change: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return products (p, p) of columns (3 N, p), and those (p,) with a change (3 N,)."""
        return self._effects.least_squares(columns, change)

    def slopes(self, added: Sequence[Mechanism]) -> tuple[np.ndarray, np.ndarray]:
        """Return (3 N, P) how whitened errors change with the parameters, and these' prior precision (P, P).

        The parameters are those of `added` mechanisms; where none is added, of those that are there.
        """
        model, chosen = self.model, list(added) or self.arriving
        around = self.arriving if added else []
        kinds = [type(one) for one in chosen]
        values, near = model.values(chosen), self.arriving
        here = model.whitened_near([*around, *chosen], near) if added else self._here
        columns, precision = [], []
        for index, (_, _, parameter) in enumerate(model.parameters(kinds)):
            moved = values.copy()
            moved[index] = parameter.stepped_from(values[index])
            changed = model.whitened_near([*around, *model.assembled(kinds, moved)], near) - here
            columns.append(changed.ravel() / (moved[index] - values[index]))
            precision.append(12 / parameter.size**2)
        together = np.stack(columns, axis=-1) if columns else np.zeros((here.size, 0))
        return together, np.diag(precision)

    def price(self, mechanism: Mechanism) -> float:
        """Return the nats that a mechanism's parameters and the choice of its form cost, as the evidence has it."""
        slopes, precision = self.slopes([mechanism])
        kind = type(mechanism)
        sizes = [one.size for _, _, one in self.model.parameters([kind])]
        curvature = float(np.linalg.slogdet(self.gram(slopes) + precision)[1]) / 2 if sizes else 0.0
        forms = math.log(len(kind.forms(self.model.robot)))
        return forms + curvature + float(np.log(sizes).sum()) - len(sizes) * math.log(2 * math.pi) / 2

    def imitation(self, change: np.ndarray, rival: Candidate) -> Mechanism | None:
        """Return a rival with the values at which it comes nearest to a change (3 N,); None where none would."""
        gram, side = self.least_squares(rival.columns, change)
        factors = np.linalg.lstsq(gram, side, rcond=1e-8)[0]
        parameters = self.model.parameters([rival.form])
        values = dict(rival.held)
        for (key, off), factor in zip(rival.off.items(), factors, strict=False):
            parameter = next(one for _, name, one in parameters if name == key)
            assert parameter.null_value is not None
            values[key] = float(np.clip(parameter.null_value + factor * off, parameter.low, parameter.high))
            if len(rival.off) == 1 and values[key] == parameter.null_value:
                return None
        return rival.form.at(values)

    def apart(self, change: np.ndarray, rival: Mechanism) -> float:
        """Return the distance of a change (3 N,) from a rival that may take other values, and another form."""
        model, around = self.model, [*self.arriving, rival]
        slopes, precision = self.slopes([rival])
        effects = model.effects_with(around, self.arriving)
        gram = effects.gram(np.column_stack([change - self.change(rival), slopes, self._slopes]))
        own = slopes.shape[1]
        gram[1 : 1 + own, 1 : 1 + own] += precision
        taken = float(gram[0, 1:] @ np.linalg.lstsq(gram[1:, 1:], gram[1:, 0], rcond=1e-10)[0])
        return math.sqrt(max(float(gram[0, 0]) - taken, 1e-12))


class Rivals:
    """What may be taken for a cause: candidates, all products of whose changes are known.

    Args:
        around: what is there already.
        candidates: those that change anything count.
    """

    def __init__(self, around: Surroundings, candidates: Sequence[Candidate]) -> None:
        self.around = around
        self.candidates = [one for one in candidates if np.any(one.columns)]
        ends = np.cumsum([one.columns.shape[1] for one in self.candidates])
        self._rows = [
            np.arange(end - one.columns.shape[1], end) for end, one in zip(ends, self.candidates, strict=True)
        ]
        size = 3 * len(around.model.session)
        columns = np.column_stack([np.zeros((size, 0)), *(one.columns for one in self.candidates)])
        self._beyond = around.beyond(columns)
        self._gram = columns.T @ self._beyond

    def alike(self, change: np.ndarray, name: str, least: float) -> list[Candidate]:
        """Return those of other names that take over a share of a change (3 N,), were they as large as need be.

        The best of each name, the most alike first; at least a share of `least`.
        """
        whole, side = float(self.around.gram(change[:, None])[0, 0]), self._beyond.T @ change
        best: dict[str, tuple[float, Candidate]] = {}
        for one, rows in zip(self.candidates, self._rows, strict=True):
            factors = np.linalg.lstsq(self._gram[np.ix_(rows, rows)], side[rows], rcond=1e-8)[0]
            share = float(factors @ side[rows]) / max(whole, 1e-300)
            if one.name != name and share > max(least, best[one.name][0] if one.name in best else 0.0):
                best[one.name] = share, one
        return [one for _, one in sorted(best.values(), key=lambda pair: -pair[0])]
