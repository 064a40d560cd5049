"""Ridge regressions, cross-fitted over runs: what is said of a run comes from coefficients that have not seen it."""

from collections.abc import Sequence

import numpy as np
from scipy import optimize


class CrossFittedRidge:
    """Ridge regressions on the same columns, prepared for any number of targets.

    Args:
        columns: (N, q) what is regressed upon.
        weight: (N,) how much each row counts.
        fold: (N,) numbers of the folds.
        ridges: candidates, over the mean of the columns' information.
        factor: (N,) what each row of the columns is multiplied by; None: 1.
        alternatives: numbers of the columns that each alternative looks at; None: one, at all of them.
    """

    def __init__(
        self,
        columns: np.ndarray,
        weight: np.ndarray,
        fold: np.ndarray,
        ridges: Sequence[float],
        factor: np.ndarray | None = None,
        alternatives: Sequence[np.ndarray] | None = None,
    ) -> None:
        factor = np.ones(len(columns)) if factor is None else factor
        alternatives = [np.arange(columns.shape[1])] if alternatives is None else alternatives
        self._columns, self._factor, self._weight = columns, factor, weight
        self._folds = [fold == number for number in np.unique(fold)]
        self._ridges, self._alternatives = ridges, alternatives
        grams = []
        for own in self._folds:
            part = columns[own] * (factor * np.sqrt(weight))[own, None]
            grams.append(part.T @ part)
        self._gram = sum(grams)
        self._others = [[np.linalg.eigh((self._gram - own)[np.ix_(few, few)]) for own in grams] for few in alternatives]

    def answers(self, target: np.ndarray, positive: bool = False) -> list[np.ndarray]:
        """Return for each alternative its answers (N,), each fold's by the others; of a few ridges those of the best.

        Args:
            target: (N,) what is to be answered; 0 is answered where no ridge comes nearer.
            positive: whether no coefficient is below 0.
        """
        aim = target * self._factor * self._weight
        sides = [self._columns[own].T @ aim[own] for own in self._folds]
        rest = [sum(sides) - side for side in sides]
        return [
            self._nearest(target, self._answers_by_ridge(number, [side[few] for side in rest], positive))
            for number, few in enumerate(self._alternatives)
        ]

    def _answers_by_ridge(self, alternative: int, sides: list[np.ndarray], positive: bool) -> np.ndarray:
        """Return (N, r) the answers of an alternative with each ridge, given what the folds' others say (q',)."""
        few = self._alternatives[alternative]
        ridges = np.array(self._ridges) * float(np.trace(self._gram[np.ix_(few, few)])) / len(few)
        answers = np.zeros((len(self._factor), len(ridges)))
        for own, (sizes, axes), side in zip(self._folds, self._others[alternative], sides, strict=True):
            turned = axes.T @ side
            precision = np.maximum(sizes, 0.0)[:, None] + ridges  # (q', r)
            coefficients = np.zeros((self._columns.shape[1], len(ridges)))
            if positive:
                for number, one in enumerate(np.sqrt(precision).T):
                    coefficients[few, number] = optimize.nnls(one[:, None] * axes.T, turned / one)[0]
            else:
                coefficients[few] = axes @ (turned[:, None] / precision)
            answers[own] = (self._columns[own] @ coefficients) * self._factor[own, None]
        return answers

    def _nearest(self, target: np.ndarray, answers: np.ndarray) -> np.ndarray:
        """Return the answers (N,) nearest to the target, of those with each ridge (N, r) and of none."""
        with_none = np.column_stack([np.zeros(len(target)), answers])
        left = self._weight @ (target[:, None] - with_none) ** 2
        nearest: np.ndarray = with_none[:, int(np.argmin(left))]
        return nearest
