"""How good synthetic rows are: against real rows that the generator has never seen, with real rows as the yardstick."""

from typing import NamedTuple

import numpy as np
import pandas as pd
from scipy.spatial import cKDTree
from scipy.stats import ks_2samp
from sklearn.ensemble import HistGradientBoostingClassifier
from sklearn.metrics import roc_auc_score
from sklearn.neighbors import KNeighborsRegressor

from swarmtwin.generators.columns import Columns
from swarmtwin.robot import DISPLACEMENT_COLUMNS, StrictModel


class Coverage(NamedTuple):
    """Shares of rows that lie within the other set's reach (improved precision and recall, Kynkäänniemi et al. 2019).

    A set reaches as far around each of its rows as that row's fifth nearest neighbour in it.

    Attributes:
        precision: of the generated rows, those that real ones reach: few are invented.
        recall: of the real rows, those that generated ones reach: few are missed.
    """

    precision: float
    recall: float


def mean_neighbour_distance(rows: np.ndarray, real: np.ndarray, neighbours: int = 8) -> float:
    """Return the authors' score of rows (N, d): the mean distance to the 8 nearest of `real` (M, d)."""
    count = min(neighbours, len(real))
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


def _within_reach(rows: np.ndarray, around: np.ndarray, neighbours: int = 5) -> float:
    """Return the share of rows that lie within reach of at least one row of `around`."""
    tree = cKDTree(around)
    reach = tree.query(around, k=[min(neighbours + 1, len(around))])[0][:, 0]
    order = np.argsort(-reach)
    reached = np.zeros(len(rows), dtype=bool)
    known = cKDTree(rows)
    for index in order:
        reached[known.query_ball_point(around[index], reach[index])] = True
    return float(reached.mean())


class Interval(StrictModel):
    """A figure with its 95 % interval."""

    value: float
    low: float
    high: float

    def __str__(self) -> str:
        return f"{self.value:.3f} ({self.low:.3f}–{self.high:.3f})"


class Comparison(StrictModel):
    """A set of rows against real rows held out.

    Attributes:
        spread: standard deviation of each displacement around what a common regressor expects: mm, mm, rad.
        precision: share of the rows within reach of held-out ones.
        recall: share of held-out rows within reach of them.
        neighbour_distance: the authors' score, mean distance to the 8 nearest rows learned from, columns scaled 0…1.
        told_apart: how well a classifier tells the rows from held-out ones: area under the curve, 0.5 where it cannot.
        largest_marginal_gap: for each column the largest difference between the two distribution functions.
    """

    spread: dict[str, float]
    precision: float
    recall: float
    neighbour_distance: float
    told_apart: Interval
    largest_marginal_gap: dict[str, float]


class Quality(StrictModel):
    """The content of `quality.json`.

    Attributes:
        held_out: which real split the rows are compared with, and how many rows of it there are.
        synthetic: generated rows against held-out ones.
        real: the yardstick: rows learned from against held-out ones.
        held_out_spread: spread of the held-out rows themselves.
        held_out_neighbour_distance: the authors' score of the held-out rows themselves.
        nearer_to_learned: share of generated rows nearer to a row learned from than to one held out: 0.5 where the
            generator generalises, more where it copies.
        exact_copies: generated rows that stand among those learned from.
        redrawn_share: share of generated rows that no robot could have driven; they were drawn again.
    """

    held_out: str
    synthetic: Comparison
    real: Comparison
    held_out_spread: dict[str, float]
    held_out_neighbour_distance: float
    nearer_to_learned: float
    exact_copies: int
    redrawn_share: float

    def rows(self) -> list[tuple[str, str, str]]:
        """Return what a person reads: a figure's name, its value for generated rows, and for real ones."""
        pairs = [
            ("precision: few are invented", "precision", "{:.3f}"),
            ("recall: few are missed", "recall", "{:.3f}"),
            ("distance to 8 nearest real rows", "neighbour_distance", "{:.4f}"),
        ]
        rows: list[tuple[str, str, str]] = [
            (name, text.format(getattr(self.synthetic, key)), text.format(getattr(self.real, key)))
            for name, key, text in pairs
        ]
        rows.append(("told apart from real, ideal 0.5", str(self.synthetic.told_apart), str(self.real.told_apart)))
        for name, known in self.held_out_spread.items():
            ratios = [part.spread[name] / known for part in (self.synthetic, self.real)]
            rows.append((f"noise of {name}, × held out", f"{ratios[0]:.3f}", f"{ratios[1]:.3f}"))
        rows.append(("nearer to learned rows, ideal 0.5", f"{self.nearer_to_learned:.3f}", ""))
        rows.append(("exact copies", str(self.exact_copies), ""))
        return rows

    def tracked(self) -> dict[str, float]:
        """Return the figures by name, as MLflow keeps them."""
        named = {
            "precision": self.synthetic.precision,
            "recall": self.synthetic.recall,
            "neighbour_distance": self.synthetic.neighbour_distance,
            "told_apart": self.synthetic.told_apart.value,
            "nearer_to_learned": self.nearer_to_learned,
            "exact_copies": self.exact_copies,
            "redrawn_share": self.redrawn_share,
        }
        noise = {f"noise_{name}": spread for name, spread in self.synthetic.spread.items()}
        gaps = {f"marginal_gap_{name}": gap for name, gap in self.synthetic.largest_marginal_gap.items()}
        return {**named, **noise, **gaps}


class Sets(NamedTuple):
    """The rows compared, each (N, width): generated, learned from, and held out."""

    synthetic: np.ndarray
    learned: np.ndarray
    held_out: np.ndarray


def assess(
    columns: Columns, sets: Sets, held_out_split: str, redrawn_share: float, seed: int, most: int = 4000
) -> Quality:
    """Measure generated rows; at most `most` of each set are compared, and which ones depends on `seed` alone."""
    random = np.random.default_rng(seed)
    synthetic, held_out = (_some(random, rows, most) for rows in (sets.synthetic, sets.held_out))
    order = random.permutation(len(sets.learned))
    known, yardstick = sets.learned[order[::2]], sets.learned[order[1::2]][:most]
    scale = _spread(columns.euclidean(sets.learned))
    near, learned_near, held_out_near = (
        columns.euclidean(rows) / scale for rows in (synthetic, sets.learned[order], held_out)
    )
    ruler = Ruler(columns, known, held_out)
    return Quality(
        held_out=f"{len(sets.held_out)} transitions of the {held_out_split} split",
        synthetic=ruler.compare(synthetic),
        real=ruler.compare(yardstick),
        held_out_spread=ruler.spread(held_out),
        held_out_neighbour_distance=ruler.neighbour_distance(held_out),
        nearer_to_learned=nearer_to_first(near, learned_near, held_out_near),
        exact_copies=exact_copies(sets.synthetic, sets.learned),
        redrawn_share=redrawn_share,
    )


def marginals(columns: Columns, sets: Sets, bins: int = 40) -> pd.DataFrame:
    """Return each column's histogram, a row a bin: column, unit, low, high, and the density of each set."""
    parts = []
    for number, (name, unit) in enumerate(columns.units.items()):
        values = {set_name: rows[:, number] for set_name, rows in sets._asdict().items()}
        ends = min(part.min() for part in values.values()), max(part.max() for part in values.values())
        edges = np.linspace(*ends, bins + 1)
        density = {set_name: np.histogram(part, edges, density=True)[0] for set_name, part in values.items()}
        about = {"column": name, "unit": unit, "low": edges[:-1], "high": edges[1:]}
        parts.append(pd.DataFrame({**about, **density}))
    return pd.concat(parts, ignore_index=True).rename(columns={"learned": "learned_from"})


class Ruler:
    """Compares sets of rows with held-out ones, all by the same regressor and the same scale.

    What a situation lets expect is the mean of 40 neighbours: enough that the regressor's own noise is small beside
    that of the motion, few enough that they are near.
    """

    def __init__(self, columns: Columns, known: np.ndarray, held_out: np.ndarray) -> None:
        """Learn regressor and scale from `known` real rows, which are in none of the sets compared."""
        self.columns = columns
        self.held_out = held_out
        self._low, self._range = known.min(axis=0), np.maximum(np.ptp(known, axis=0), 1e-9)
        self._known = self._scaled(known)
        self._scale = _spread(columns.euclidean(known))
        self._situation_scale = _spread(columns.euclidean(known[:, : columns.situation_width]))
        neighbours = min(40, max(1, len(known) // 10))
        self._regressor = KNeighborsRegressor(neighbours, weights="distance")
        self._regressor.fit(self._situation(known), known[:, -3:])

    def compare(self, rows: np.ndarray) -> Comparison:
        """Compare rows (N, width) with the held-out ones."""
        near = [self.columns.euclidean(part) / self._scale for part in (rows, self.held_out)]
        reached = coverage(*near)
        gaps = zip(self.columns.units, rows.T, self.held_out.T, strict=True)
        return Comparison(
            spread=self.spread(rows),
            precision=reached.precision,
            recall=reached.recall,
            neighbour_distance=self.neighbour_distance(rows),
            told_apart=told_apart(*near),
            largest_marginal_gap={name: float(ks_2samp(own, real).statistic) for name, own, real in gaps},
        )

    def spread(self, rows: np.ndarray) -> dict[str, float]:
        """Return the standard deviation of the displacements around what their situations let expect."""
        residual = self.residual(rows)
        return dict(zip(DISPLACEMENT_COLUMNS, residual.std(axis=0).tolist(), strict=True))

    def residual(self, rows: np.ndarray) -> np.ndarray:
        """Return (N, 3) how the displacements differ from what their situations let expect."""
        residual: np.ndarray = rows[:, -3:] - self._regressor.predict(self._situation(rows))
        return residual

    def neighbour_distance(self, rows: np.ndarray) -> float:
        """Return the authors' score."""
        return mean_neighbour_distance(self._scaled(rows), self._known)

    def _situation(self, rows: np.ndarray) -> np.ndarray:
        """Return the inputs of the regressor, each of unit spread."""
        situation = self.columns.euclidean(rows[:, : self.columns.situation_width])
        scaled: np.ndarray = situation / self._situation_scale
        return scaled

    def _scaled(self, rows: np.ndarray) -> np.ndarray:
        scaled: np.ndarray = (rows - self._low) / self._range
        return scaled


def told_apart(rows: np.ndarray, real: np.ndarray) -> Interval:
    """Let boosted trees learn from every other row to tell rows (N, d) from real ones (M, d), and judge the rest.

    A two-sample test: the interval of the area under the curve is Hanley and McNeil's (1982), and holds because the
    trees are judged on rows that they have not seen.
    """
    count = min(len(rows), len(real))
    known, asked = (np.concatenate([part[start:count:2] for part in (rows, real)]) for start in (0, 1))
    known_truth, truth = (np.repeat([1, 0], len(part) // 2) for part in (known, asked))
    classifier = HistGradientBoostingClassifier(max_iter=60, random_state=0).fit(known, known_truth)
    area = float(roc_auc_score(truth, classifier.predict_proba(asked)[:, 1]))
    judged = len(asked) // 2
    first, second = area / (2 - area), 2 * area**2 / (1 + area)
    variance = (area * (1 - area) + (judged - 1) * (first + second - 2 * area**2)) / judged**2
    half_width = 1.96 * float(np.sqrt(max(variance, 0)))
    return Interval(value=area, low=area - half_width, high=area + half_width)


def _spread(values: np.ndarray) -> np.ndarray:
    """Return the standard deviation of each column of (N, d), 1 where it does not vary."""
    spread = values.std(axis=0)
    return np.where(spread > 0, spread, 1.0)


def _some(random: np.random.Generator, rows: np.ndarray, most: int) -> np.ndarray:
    return rows[random.permutation(len(rows))[:most]]
