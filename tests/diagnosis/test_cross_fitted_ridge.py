"""Ridge regressions answer each fold by the others alone, as textbooks have it."""

import numpy as np
import pytest

from swarmtwin.diagnosis.cross_fitted_ridge import CrossFittedRidge

RNG = np.random.default_rng(1)
COLUMNS = RNG.normal(size=(120, 4))
FOLD = np.repeat(np.arange(40), 3) % 4
WEIGHT, FACTOR = RNG.uniform(0.5, 1.0, 120), RNG.uniform(0.5, 2.0, 120)
TARGET = COLUMNS @ [1.0, -0.5, 0.0, 0.3] * FACTOR + 0.5 * RNG.normal(size=120)


def ridge(columns, target, weight, fold, ridge):
    """Answers (N,) by the normal equations, written down."""
    answers = np.zeros(len(target))
    penalty = ridge * np.trace(columns.T @ (weight[:, None] * columns)) / columns.shape[1]
    for own in (fold == number for number in np.unique(fold)):
        others, counts = columns[~own], weight[~own, None]
        gram = others.T @ (counts * others) + penalty * np.eye(columns.shape[1])
        answers[own] = columns[own] @ np.linalg.solve(gram, others.T @ (counts[:, 0] * target[~own]))
    return answers


def test_each_fold_is_answered_by_the_others():
    (answers,) = CrossFittedRidge(COLUMNS, WEIGHT, FOLD, [0.1], FACTOR).answers(TARGET)
    np.testing.assert_allclose(answers, ridge(COLUMNS * FACTOR[:, None], TARGET, WEIGHT, FOLD, 0.1), atol=1e-10)


def test_the_ridge_that_comes_nearest_is_taken():
    (answers,) = CrossFittedRidge(COLUMNS, WEIGHT, FOLD, [0.01, 1.0, 100.0]).answers(TARGET)
    each = [ridge(COLUMNS, TARGET, WEIGHT, FOLD, one) for one in (0.01, 1.0, 100.0)]
    left = [WEIGHT @ (TARGET - one) ** 2 for one in each]
    np.testing.assert_allclose(answers, each[int(np.argmin(left))], atol=1e-10)


def test_an_alternative_is_the_regression_on_its_columns_alone():
    few = np.array([0, 3])
    both = CrossFittedRidge(COLUMNS, WEIGHT, FOLD, [0.1, 1.0], FACTOR, [np.arange(4), few]).answers(TARGET)
    (alone,) = CrossFittedRidge(COLUMNS[:, few], WEIGHT, FOLD, [0.1, 1.0], FACTOR).answers(TARGET)
    np.testing.assert_allclose(both[1], alone, atol=1e-10)
    assert np.abs(both[0] - alone).max() > 0.1


def test_nothing_is_answered_where_no_ridge_comes_nearer():
    unrelated = np.random.default_rng(2).normal(size=120)
    (answers,) = CrossFittedRidge(COLUMNS, WEIGHT, FOLD, [1e-6]).answers(unrelated)
    assert not answers.any()


def test_no_coefficient_is_below_0_where_that_is_asked():
    regression = CrossFittedRidge(COLUMNS[:, :1], WEIGHT, FOLD, [1e-6])
    assert not regression.answers(-COLUMNS[:, 0], positive=True)[0].any()
    assert regression.answers(COLUMNS[:, 0], positive=True)[0] == pytest.approx(COLUMNS[:, 0], abs=1e-3)
