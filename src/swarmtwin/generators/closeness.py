"""How near rows are to each other: distances to nearest neighbours, coverage, and copies."""

from typing import NamedTuple

import numpy as np
from scipy.spatial import cKDTree

AUTHORS_NEIGHBOURS = 8
COVERAGE_NEIGHBOURS = 5


class Coverage(NamedTuple):
    """Shares of rows that lie within the other set's reach (improved precision and recall, Kynkäänniemi et al. 2019).

    A set reaches as far around each of its rows as that row's fifth nearest neighbour in it.

    Attributes:
        precision: of the generated rows, those that real ones reach: few are invented.
        recall: of the real rows, those that generated ones reach: few are missed.
    """

    precision: float
    recall: float


def mean_neighbour_distance(rows: np.ndarray, real: np.ndarray) -> float:
    """Return the authors' score of rows (N, d): the mean distance to the 8 nearest of `real` (M, d)."""
    count = min(AUTHORS_NEIGHBOURS, len(real))
    distance, _ = cKDTree(real).query(rows, k=np.arange(1, count + 1))
    return float(distance.mean())


def coverage(rows: np.ndarray, real: np.ndarray) -> Coverage:
    """Compare as many rows (N, d) as there are of `real` (M, d); the larger set is cut to the smaller one's length."""
    count = min(len(rows), len(real))
    rows, real = rows[:count], real[:count]
    return Coverage(precision=_within_reach(rows, real), recall=_within_reach(real, rows))


def nearer_to_first(rows: np.ndarray, first: np.ndarray, second: np.ndarray) -> float:
    """Return the share of rows (N, d) that are nearer to `first` than to `second`, cut to equal lengths.

    With `first` what a generator learned from and `second` real rows that it has never seen: about a half where it
    generalises, more where it copies. Ties count half.
    """
    count = min(len(first), len(second))
    to_first, to_second = (cKDTree(part[:count]).query(rows)[0] for part in (first, second))
    return float((to_first < to_second).mean() + (to_first == to_second).mean() / 2)


def exact_copies(rows: np.ndarray, real: np.ndarray) -> int:
    """Count the rows (N, d) that stand in `real` (M, d), as 32-bit numbers."""
    known = {row.tobytes() for row in real.astype(np.float32)}
    return sum(row.tobytes() in known for row in rows.astype(np.float32))


def _within_reach(rows: np.ndarray, around: np.ndarray) -> float:
    """Return the share of rows that lie within reach of at least one row of `around`."""
    tree = cKDTree(around)
    reach = tree.query(around, k=[min(COVERAGE_NEIGHBOURS + 1, len(around))])[0][:, 0]
    order = np.argsort(-reach)
    reached = np.zeros(len(rows), dtype=bool)
    known = cKDTree(rows)
    for index in order:
        reached[known.query_ball_point(around[index], reach[index])] = True
    return float(reached.mean())
