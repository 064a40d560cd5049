"""The figures of quality find what was planted: copies, collapsed noise, missed regions, wrong distributions."""

import numpy as np
import pytest
from plant import planted

from swarmtwin.generators.columns import Columns
from swarmtwin.generators.quality import (
    Quality,
    Sets,
    assess,
    coverage,
    exact_copies,
    marginals,
    mean_neighbour_distance,
    nearer_to_first,
    told_apart,
)
from swarmtwin.generators.quality_plots import quality_figure


@pytest.fixture(scope="module")
def columns(robots):
    return Columns.of(robots["mgr"])


def rows_of(columns, seed, count=2000, **changes):
    return columns.rows(planted(columns.robot, count, seed=seed, **changes))


@pytest.fixture(scope="module")
def sets(columns):
    """Generated rows from the very distribution that the real ones come from."""
    return Sets(rows_of(columns, 1), rows_of(columns, 2, 3000), rows_of(columns, 3))


def test_perfect_samples_measure_like_real_rows(columns, sets):
    quality = assess(columns, sets, "test", 0.0, seed=0)
    assert quality.synthetic.told_apart.low < 0.5 < quality.synthetic.told_apart.high
    assert quality.nearer_to_learned == pytest.approx(0.5, abs=0.04)
    assert quality.exact_copies == 0
    for name, spread in quality.synthetic.spread.items():
        assert spread == pytest.approx(quality.held_out_spread[name], rel=0.08)
    assert quality.synthetic.precision == pytest.approx(quality.real.precision, abs=0.03)
    assert quality.synthetic.recall == pytest.approx(quality.real.recall, abs=0.03)


def test_copies_are_found(columns, sets):
    quality = assess(columns, sets._replace(synthetic=sets.learned[:2000]), "test", 0.0, seed=0)
    assert quality.exact_copies == 2000
    assert quality.nearer_to_learned > 0.8


def test_nearly_copied_rows_are_found(columns, sets):
    random = np.random.default_rng(0)
    jittered = sets.learned[:2000] * (1 + 0.01 * random.normal(size=(2000, 5)))
    quality = assess(columns, sets._replace(synthetic=jittered), "test", 0.0, seed=0)
    assert quality.exact_copies == 0
    assert quality.nearer_to_learned > 0.75


def test_collapsed_noise_is_found(columns, sets):
    collapsed = rows_of(columns, 1, noise=np.array([0.2, 0.1, 0.005]))
    quality = assess(columns, sets._replace(synthetic=collapsed), "test", 0.0, seed=0)
    for name, spread in quality.synthetic.spread.items():
        assert spread < 0.8 * quality.held_out_spread[name]
    assert quality.synthetic.told_apart.low > 0.55


def test_a_missed_region_lowers_recall_and_an_invented_one_precision(columns, sets):
    half = sets.synthetic[sets.synthetic[:, 0] > 0]
    quality = assess(columns, sets._replace(synthetic=half), "test", 0.0, seed=0)
    assert quality.synthetic.recall < 0.75 < quality.synthetic.precision
    assert quality.synthetic.largest_marginal_gap["left"] == pytest.approx(0.5, abs=0.05)
    moved = sets.synthetic + np.array([0, 0, 300, 0, 0])
    assert assess(columns, sets._replace(synthetic=moved), "test", 0.0, seed=0).synthetic.precision < 0.02


def test_the_same_seed_assesses_the_same(columns, sets):
    first, second = (assess(columns, sets, "test", 0.0, seed=4) for _ in range(2))
    assert first == second
    assert Quality.model_validate_json(first.model_dump_json()) == first


def test_distances_and_gaps_by_hand():
    line = np.arange(20.0)[:, None]
    assert mean_neighbour_distance(np.array([[0.0]]), line) == pytest.approx(np.arange(8).mean())
    assert exact_copies(line, line[:5]) == 5
    assert nearer_to_first(line, line, line + 0.5) == 1
    assert nearer_to_first(line, line, line) == 0.5
    assert coverage(line, line) == (1, 1)
    assert coverage(line + 1000, line) == (0, 0)


def test_the_two_sample_test_keeps_its_level():
    random = np.random.default_rng(1)
    equal = [told_apart(random.normal(size=(300, 2)), random.normal(size=(300, 2))) for _ in range(20)]
    assert sum(interval.low < 0.5 < interval.high for interval in equal) >= 17
    assert told_apart(random.normal(size=(300, 2)), random.normal(1, 1, size=(300, 2))).low > 0.7


def test_the_figure_shows_every_column(columns, sets):
    quality = assess(columns, sets, "test", 0.0, seed=0)
    titles = " ".join(panel.get_title() for panel in quality_figure(marginals(columns, sets), quality, "a title").axes)
    assert all(name in titles for name in columns.units)
