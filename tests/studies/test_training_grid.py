"""Tables 1 to 4 and figures 7 to 13: what is planted is found, intervals cover, and every claim has its trainings."""

import functools

import hydra
import numpy as np
import pandas as pd
import pytest
from omegaconf import OmegaConf

from swarmtwin.commands.experiment import experiments, study_module
from swarmtwin.configuration import config_folder
from swarmtwin.dynamics.model_config import model_config
from swarmtwin.errors import UserError
from swarmtwin.generators.generator import generator_config
from swarmtwin.studies.training_grid.claims import Claim, conclude, judge
from swarmtwin.studies.training_grid.comparison import FAILS, HOLDS, OPEN, Difference, Judging, compare, overall
from swarmtwin.studies.training_grid.enough_data import enough_data
from swarmtwin.studies.training_grid.grid_data import (
    GridData,
    drawn_runs,
    steps_an_epoch,
    with_epochs,
    with_noise,
)
from swarmtwin.studies.training_grid.grid_plots import curve_figure, dots_figure, heat_map_figure
from swarmtwin.studies.training_grid.measured_errors import RunErrors
from swarmtwin.studies.training_grid.options import Options
from swarmtwin.studies.training_grid.result_table import brief_table, shown_table
from swarmtwin.studies.training_grid.table_file import read_table
from swarmtwin.studies.training_grid.training_store import key_of
from swarmtwin.studies.training_grid.trainings import Grid, Training, all_trainings, chosen
from swarmtwin.transitions import SPLITS, Fractions, Preparation
from swarmtwin.transitions.preparation import CountsByReason, counts_by_split, runs_by_split
from toy import recipe, toy_transitions

JUDGING = Judging(margin=0.02, fewest_runs=6, resamples=2000, seed=0)
GRIDS = [name for name in experiments() if study_module(name).endswith("training_grid.study")]


def run_errors(position_mm, transitions=None):
    """Errors of runs of equal length, unless it is said how long each is."""
    count = len(position_mm)
    return RunErrors(
        runs=tuple(f"run-{number}" for number in range(count)),
        transitions=tuple(transitions or [40] * count),
        position_mm=tuple(map(float, position_mm)),
        orientation_deg=tuple(map(float, position_mm)),
        open_loop_mm=(None, *map(float, position_mm[1:])),
    )


def by_seed(mean, seeds=3, runs=30, run_sd=0.5, seed_sd=0.0, rng=0, shared=None):
    """Errors by seed: what runs have in common, what a seed adds, and a little noise of both."""
    random = np.random.default_rng(rng)
    of_run = random.normal(0, run_sd, runs) if shared is None else shared
    noise = [random.normal(0, seed_sd) + random.normal(0, 0.02, runs) for _ in range(seeds)]
    return {seed: run_errors(mean + of_run + noise[seed]) for seed in range(seeds)}


def errors_of(means, **options):
    """Errors on another vehicle of some trainings, by their mean errors, on the same runs."""
    shared = np.random.default_rng(9).normal(0, 0.5, 30)
    return {
        training: {"other_vehicle": by_seed(mean, rng=number, shared=shared, **options)}
        for number, (training, mean) in enumerate(means.items())
    }


# --- the grid ---------------------------------------------------------------------------------------------------------


def test_a_grid_is_every_combination_and_a_mixture_that_is_all_measured_has_no_generator():
    grid = Grid(models=("crnet", "mlp"), generators=("gan",), real_share=(0.0, 0.5, 1.0))
    trainings = list(grid.trainings())
    assert len(trainings) == 6
    assert [training.measured_share for training in trainings[:3]] == [0.0, 0.5, 1.0]
    assert trainings[2] == Training(model="crnet")
    assert len(all_trainings([grid, Grid(models=("crnet",))])) == 6


def test_what_is_compared_agrees_in_the_amount_whichever_kind_it_is():
    grid = all_trainings(
        [Grid(models=("mlp",), real=(0.1, 1.0)), Grid(models=("mlp",), generators=("gan",), synthetic=(0.1, 1.0))]
    )
    claim = Claim(
        says="", where="", relation="better", of={"generator": "gan"}, than={"generator": None}, same=("size",)
    )
    assert [(first.synthetic, second.real) for first, second in claim.pairs(grid)] == [(0.1, 0.1), (1.0, 1.0)]


def test_titles_tell_all_trainings_of_an_experiment_apart():
    for options in shipped():
        titles = [training.title(50_000) for training in options.grid]
        assert len(set(titles)) == len(titles), options.name


def test_an_unknown_field_in_a_selector_names_the_one_meant():
    with pytest.raises(UserError, match=r"no such field of a training: 'modle': did you mean 'model'\?"):
        Claim.parse({"says": "", "where": "", "relation": "better", "of": {"modle": "mlp"}, "than": {}}, "options")


# --- what is learned from ---------------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def data(robots):
    transitions = toy_transitions(robots["mgr"], 3000, noise=(1.0, 1.0, 0.02))
    preparation = Preparation(
        recording="toy",
        digest="0",
        source="toy",
        vehicles=("1",),
        robot="mgr",
        fractions=Fractions(train=0.6, validation=0.2, test=0.2),
        seed=1,
        counts=CountsByReason(rows=0, dropped_rows={}, considered=0, kept=0, dropped={}),
        runs=runs_by_split(transitions),
        transitions=counts_by_split(transitions),
        learned=(),
    )
    models = {name: model_config({"name": name, "learning_rate": 0.01, "steps": 50}, name) for name in ("mlp", "crnet")}
    generators = {"gan": generator_config({"name": "gan"}, "gan")}
    return GridData((transitions, preparation), models, generators, recipe(batch_size=64), None)


def made_of(data, training, seed=1):
    everything = data.identified_part(Training(model="mlp"), 1)
    return data.made_of(training, seed, data.identified_part(training, seed), everything)


def test_equal_steps_are_equal_and_equal_epochs_are_equal(data):
    everything = len(data.real[0].part("train"))
    full = data.recipe_for(Training(model="mlp"), everything)
    total = full.epochs * steps_an_epoch(full, everything)
    for rows in (40, 100, 500):
        few = data.recipe_for(Training(model="mlp", real=0.1), rows)
        assert 0 <= few.epochs * steps_an_epoch(few, rows) - total < steps_an_epoch(few, rows)
        assert data.recipe_for(Training(model="mlp", real=0.1, equal="epochs"), rows).epochs == full.epochs


def test_a_recipe_that_counts_epochs_is_made_longer_for_fewer_rows_at_equal_steps(data):
    counting = GridData(data.real, data.models, data.generators, recipe("paper", epochs=4), None)
    everything = len(data.real[0].part("train"))
    assert counting.recipe_for(Training(model="mlp"), everything).epochs == 4
    assert counting.recipe_for(Training(model="mlp", real=0.1), everything // 10).epochs > 30
    assert counting.recipe_for(Training(model="mlp", real=0.1, equal="epochs"), everything // 10).epochs == 4


def test_fewer_real_transitions_are_whole_runs_of_the_seeds_own_and_none_of_the_test(data):
    everything = data.real[0]
    parts = [drawn_runs(everything, 600, seed) for seed in (1, 1, 2)]
    assert parts[0].digest() == parts[1].digest() != parts[2].digest()
    for part in parts:
        assert len(part) == pytest.approx(600, abs=50)
        assert SPLITS.index("test") not in part.split
        for run in np.unique(part.run):
            assert (part.run == run).sum() == (everything.run == run).sum()


def test_noise_is_added_to_what_is_trained_on_alone_and_as_large_as_said(data):
    everything = data.real[0]
    added = with_noise(everything, 3.0, seed=1).displacement - everything.displacement
    trained_on = everything.split == SPLITS.index("train")
    assert not added[~trained_on].any()
    np.testing.assert_allclose(added[trained_on].std(axis=0), [3.0, 3.0, np.radians(3.0)], rtol=0.06)
    assert with_noise(everything, 0.0, seed=1) is everything


def test_an_epoch_of_a_generator_is_a_pass_over_its_real_rows():
    config = generator_config({"name": "gan", "batch_size": 64, "discriminator_steps": 3}, "gan")
    longer = with_epochs(config, 10, rows=9600)
    assert longer.training_steps * 3 * 32 == 10 * 9600
    diffusion = generator_config({"name": "residual_diffusion"}, "diffusion")
    with pytest.raises(UserError, match="has no batch_size, discriminator_steps and steps"):
        with_epochs(diffusion, 10, rows=9600)


def test_a_training_is_known_by_all_that_decides_it_and_by_nothing_else(data):
    known = {
        key_of(made_of(data, training, seed))
        for training, seed in [
            (Training(model="mlp"), 1),
            (Training(model="mlp"), 2),
            (Training(model="crnet"), 1),
            (Training(model="mlp", history=True), 1),
            (Training(model="mlp", noise=1.0), 1),
            (Training(model="mlp", real=0.5), 1),
            (Training(model="mlp", real=0.5, equal="epochs"), 1),
            (Training(model="mlp", learning_rate=1e-4), 1),
            (Training(model="mlp", steps=500), 1),
            (Training(model="mlp", generator="gan"), 1),
            (Training(model="mlp", generator="gan", synthetic=0.5), 1),
            (Training(model="mlp", generator="gan", real=0.5), 1),
            (Training(model="mlp", generator="gan", real_share=0.5), 1),
            (Training(model="mlp", generator="gan", generator_epochs=3.0), 1),
        ]
    }
    assert len(known) == 14
    same = made_of(data, Training(model="mlp")), made_of(data, Training(model="mlp", equal="epochs"))
    assert same[0] == same[1]


# --- comparisons ------------------------------------------------------------------------------------------------------


def test_a_planted_difference_is_found_and_its_interval_holds_it():
    shared = np.random.default_rng(3).normal(0, 0.5, 30)
    first, second = by_seed(4.3, rng=1, shared=shared), by_seed(4.0, rng=2, shared=shared)
    found = compare(first, second, "position_mm", JUDGING)
    assert found.low < 0.3 < found.high
    assert found.difference == pytest.approx(0.3, abs=0.02)
    assert found.high - found.low < 0.05  # paired: what the runs have in common does not count
    assert (found.seeds, found.runs) == (3, 30)


def test_runs_weigh_by_their_transitions_in_one_step_errors_and_alike_open_loop():
    long_run_first = [400, *[10] * 5]
    first, second = run_errors([2.0] + [1.0] * 5, long_run_first), run_errors([1.0] * 6, long_run_first)
    assert compare({1: first}, {1: second}, "position_mm", JUDGING).difference == pytest.approx(400 / 450)
    open_loop = compare({1: first}, {1: second}, "open_loop_mm", JUDGING)  # whose first run cannot be predicted
    assert (open_loop.difference, open_loop.runs) == (0.0, 5)


def test_the_spread_of_few_seeds_is_not_taken_for_too_small():
    """Of seeds that differ by a normal of one, the interval's own variance is on average that of their mean."""
    random, variances = np.random.default_rng(0), []
    for _ in range(150):
        seeds = random.normal(0, 1, 3)
        first = {seed: run_errors(np.full(10, 5 + value)) for seed, value in enumerate(seeds)}
        second = {seed: run_errors(np.full(10, 5.0)) for seed in range(3)}
        found = compare(first, second, "position_mm", JUDGING)
        assert found.low <= seeds.mean() <= found.high
        variances.append(found.high - found.low)
    means = random.normal(0, 1, (10_000, 3))
    widest = means.max(axis=1) - means.min(axis=1)
    assert np.mean(variances) == pytest.approx(widest.mean(), rel=0.1)  # of three, two are drawn: from least to most


def test_an_interval_covers_a_planted_difference_as_often_as_it_says():
    covered = 0
    for trial in range(120):
        shared = np.random.default_rng(trial).normal(0, 0.5, 30)
        first = by_seed(4.1, seeds=8, seed_sd=0.05, rng=1000 + trial, shared=shared)
        second = by_seed(4.0, seeds=8, seed_sd=0.05, rng=2000 + trial, shared=shared)
        found = compare(first, second, "position_mm", Judging(**{**JUDGING.model_dump(), "resamples": 400}))
        covered += found.low <= 0.1 <= found.high
    assert 0.86 <= covered / 120 <= 1.0


@pytest.mark.parametrize(
    ("low", "high", "better", "not_worse", "not_better"),
    [
        (-0.5, -0.3, HOLDS, HOLDS, FAILS),
        (-0.05, 0.05, OPEN, HOLDS, HOLDS),
        (0.3, 0.5, FAILS, FAILS, HOLDS),
        (-0.5, 0.5, OPEN, OPEN, OPEN),
        (0.0, 0.2, FAILS, OPEN, HOLDS),
    ],
)
def test_verdicts_follow_from_the_whole_interval(low, high, better, not_worse, not_better):
    difference = Difference(5.0, 5.0, (low + high) / 2, low, high, seeds=3, runs=30)
    verdicts = [difference.verdict(relation, JUDGING) for relation in ("better", "not_worse", "not_better")]
    assert verdicts == [better, not_worse, not_better]
    few = difference._replace(runs=5)
    assert few.verdict("better", JUDGING) == OPEN


def test_a_claim_holds_where_all_comparisons_do():
    assert overall([HOLDS, HOLDS]) == HOLDS
    assert overall([HOLDS, OPEN]) == OPEN
    assert overall([HOLDS, OPEN, FAILS]) == FAILS
    assert overall([]) == OPEN


def test_a_claim_that_weak_baselines_bear_out_is_told_from_one_that_holds():
    crnet, weak, mlp = Training(model="crnet"), Training(model="fcnn"), Training(model="mlp")
    than = {"relation": "better", "of": {"model": "crnet"}}
    claim = Claim.parse(
        {**than, "says": "best", "where": "a table", "than": {"model": "fcnn"}}
        | {"controls": {"plain_mlp": {**than, "than": {"model": "mlp"}}}},
        "claim",
    )
    judged = judge(claim, errors_of({crnet: 4.0, weak: 9.0, mlp: 3.9}), 1000, JUDGING)
    assert judged.judged.verdict == HOLDS
    assert judged.findings == ("holds", "weak_baselines")
    (compared,) = judged.judged.compared
    assert "crnet-R errs 4." in compared.sentence
    assert compared.sentence.endswith(": better")
    worse = judge(claim, errors_of({crnet: 9.5, weak: 9.0, mlp: 3.9}), 1000, JUDGING)
    assert worse.findings == ("fails",)
    better = judge(claim, errors_of({crnet: 3.0, weak: 9.0, mlp: 3.9}), 1000, JUDGING)
    assert better.findings == ("holds", "beats_plain_mlp")
    assert judge(claim, errors_of({mlp: 3.9}), 1000, JUDGING) is None


def test_a_training_without_a_live_seed_decides_nothing_and_is_said_to_be_dead():
    crnet, dead = Training(model="crnet"), Training(model="fcnn")
    claim = Claim.parse(
        {"relation": "better", "of": {"model": "crnet"}, "than": {"model": "fcnn"}, "says": "best", "where": ""},
        "claim",
    )
    judged = judge(claim, {**errors_of({crnet: 4.0}), dead: {"other_vehicle": {}}}, 1000, JUDGING)
    assert judged.judged.verdict == OPEN
    assert judged.judged.compared[0].sentence == "crnet-R against fcnn-R: fcnn-R has no live seed"


@pytest.mark.parametrize(
    ("verdict", "controls", "findings"),
    [
        (HOLDS, {"equal_steps": FAILS}, ("holds", "counting_epochs")),
        (HOLDS, {"equal_steps": OPEN}, ("holds", "counting_epochs")),
        (HOLDS, {"equal_steps": HOLDS}, ("holds", "equal_steps")),
        (HOLDS, {"without_generator": HOLDS}, ("holds", "needless_generator")),
        (
            FAILS,
            {"without_generator": HOLDS, "other_generator": HOLDS},
            ("fails", "needless_generator", "other_generator"),
        ),
        (FAILS, {"plain_mlp": FAILS, "equal_steps": FAILS}, ("fails",)),
        (OPEN, {}, ("open",)),
    ],
)
def test_what_follows_of_a_claim_and_its_controls(verdict, controls, findings):
    assert conclude(verdict, controls) == findings


def test_a_claim_that_only_some_baselines_bear_out_is_said_to_rest_on_them():
    assert conclude(FAILS, {"plain_mlp": FAILS}, some_hold=True) == ("fails", "some_baselines")
    assert conclude(FAILS, {"plain_mlp": FAILS}, some_hold=False) == ("fails",)
    assert conclude(OPEN, {"equal_steps": FAILS}, some_hold=True) == ("open", "some_epochs")


def test_the_fewest_real_transitions_that_are_enough_are_found():
    amounts = {0.03: 4.6, 0.1: 4.02, 0.3: 4.0, 1.0: 4.0}
    means = {Training(model="mlp", real=share): error for share, error in amounts.items()}
    means |= {Training(model="mlp", generator="gan", real=share): 5.0 for share in amounts}
    real, gan = enough_data(errors_of(means), 1000, JUDGING)
    assert (real.generator, real.tried, real.fewest) == (None, (30, 100, 300, 1000), 100)
    assert (gan.generator, gan.fewest) == ("gan", None)
    assert "from 100 (10%)" in real.sentence
    assert "from none of 30, 100, 300, 1,000" in gan.sentence


# --- the shipped experiments ------------------------------------------------------------------------------------------


@functools.cache
def shipped(scale="quick"):
    """The options of each shipped experiment on a grid of trainings."""
    return list(_shipped(scale))


def _shipped(scale):
    for name in GRIDS:
        with hydra.initialize_config_dir(str(config_folder()), version_base="1.3"):
            composed = hydra.compose(f"experiment/{name}", [f"scale={scale}", "output=out"])
        yield Options.parse(OmegaConf.to_container(composed, resolve=True), name)


@pytest.mark.parametrize("scale", ["quick", "paper"])
def test_every_claim_control_and_published_figure_has_its_trainings(scale):
    assert len(GRIDS) == 12
    for options in shipped(scale):
        grid = options.grid
        for claim in options.claims:
            if options.name == "table4" and not any(chosen(grid, selector) for selector in [claim.than]):
                continue  # of generators that are not shipped
            assert list(claim.pairs(grid)), (options.name, claim.says)
            for kind, control in claim.controls.items():
                assert list(control.pairs(grid)), (options.name, claim.says, kind)
        for published in (one for own in options.published.values() for one in own):
            assert chosen(grid, published.of) or options.name == "table4", (options.name, published.of)


def test_the_plain_mlp_and_equal_steps_stand_in_every_experiment():
    for options in shipped():
        assert "mlp" in {training.model for training in options.grid}, options.name
        if len({training.size for training in options.grid}) > 1:
            assert "steps" in {training.equal for training in options.grid}, options.name


def test_every_shipped_configuration_of_models_and_generators_is_found():
    for options in shipped():
        assert set(options.models) <= options.model_configs().keys()
        assert set(options.generators) == options.generator_configs().keys()


# --- table and pictures -----------------------------------------------------------------------------------------------


def table_of(trainings, errors, tmp_path):
    """A table.csv as a study leaves it, of two recordings, with floors and one figure of the paper."""
    rows = []
    for training, error in zip(trainings, errors, strict=True):
        for recording in ("train_vehicle", "other_vehicle"):
            rows.append(
                {
                    "title": training.title(1000),
                    **training.model_dump(),
                    "size": training.size,
                    "measured_share": training.measured_share,
                    "all_real": 1000,
                    "real_transitions": round(1000 * training.real),
                    "steps": 300,
                    "seeds": 3,
                    "dead_seeds": int(np.isnan(error)),
                    "dead_because": None,
                    "recording": recording,
                    "position_mm": error,
                    "position_sd_mm": 2.0,
                    "position_mm_over_seeds": 0.1,
                    "orientation_deg": error,
                    "orientation_sd_deg": 3.0,
                    "floor_command_position_mm": 3.0,
                    "floor_command_orientation_deg": 3.5,
                    "paper_position_mm": 4.06 if training.model == "crnet" else None,
                    "paper_position_sd_mm": 3.6 if training.model == "crnet" else None,
                }
            )
    pd.DataFrame(rows).to_csv(tmp_path / "table.csv", index=False)
    return read_table(tmp_path / "table.csv")


def test_the_table_begins_with_the_floor_and_has_the_papers_figures_beneath_ours(tmp_path):
    table = table_of([Training(model="crnet"), Training(model="fcnn")], [3.4, np.nan], tmp_path)
    rows = shown_table(table, "Table 1").rows
    assert [row[0] for row in rows] == ["floor, given the command", "crnet-R", "· the paper's robots", "fcnn-R"]
    assert rows[0][3] == "3.00; 3.50"
    assert rows[1][3] == "3.40 ± 2.00 (0.10); 3.40 ± 3.00"
    assert rows[2][4] == "4.06 ± 3.60"
    assert rows[3][3:5] == ["dead", "dead"]
    assert brief_table(table, "Table 1").rows[1][2] == "3.40 (0.10)"


def test_pictures_show_what_the_table_says(tmp_path):
    trainings = [Training(model="crnet"), Training(model="mlp"), Training(model="fcnn")]
    panel = dots_figure(table_of(trainings, [3.4, 3.3, 40.0], tmp_path), "dots").axes[1]
    assert panel.containers[0].lines[0].get_xdata() == pytest.approx([3.4, 3.3])
    assert any("40.0" in text.get_text() for text in panel.texts)
    curves = [Training(model="mlp", real=share, equal=equal) for equal in ("steps", "epochs") for share in (0.1, 1.0)]
    lines = curve_figure(table_of(curves, [4.0, 3.3, 6.0, 3.3], tmp_path), "size", "curve").axes[1].lines
    drawn = {line.get_label(): line.get_xydata().tolist() for line in lines}
    assert drawn["equal steps"] == [[100.0, 4.0], [1000.0, 3.3]]
    assert drawn["equal epochs"][0] == [100.0, 6.0]
    cells = [Training(model="mlp", generator="gan", real=r, synthetic=s) for r in (0.1, 1.0) for s in (0.1, 1.0)]
    cells += [Training(model="mlp", real=0.1), Training(model="crnet", real=0.1)]
    figure = heat_map_figure(table_of(cells, [9.0, 8.0, 7.0, 6.0, 5.0, 4.0], tmp_path), "map")
    shown = [text.get_text() for text in figure.axes[0].texts]
    assert shown == ["5.00", "9.00", "8.00", "dead", "7.00", "6.00"]
