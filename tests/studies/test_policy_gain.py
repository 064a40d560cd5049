"""What policies gain by an extended simulation: the figures are those of the roll-outs, and the whole way is gone."""

import json

import hydra
import numpy as np
import pandas as pd
import pytest
from omegaconf import OmegaConf

from swarmtwin.configuration import config_folder
from swarmtwin.errors import UserError
from swarmtwin.standin.live import LiveVehicles
from swarmtwin.studies.policy_gain.options import Options
from swarmtwin.studies.policy_gain.study import run
from swarmtwin.studies.policy_gain.table import gain_table
from swarmtwin.studies.policy_gain.trials import Estimate, Trials
from swarmtwin.studies.stand_in_families import live_vehicles_of


def trials(success, reward=None):
    success = np.array(success, bool)
    rewards = np.zeros(success.shape) if reward is None else np.broadcast_to(reward, success.shape)
    return Trials(tuple(range(len(success))), success, ~success, rewards)


def test_a_gain_is_the_difference_of_the_means_over_seeds_and_starts():
    before, after = trials([[1, 0, 0, 0], [0, 0, 0, 0]]), trials([[1, 1, 1, 0], [1, 1, 1, 1]])
    assert after.gain("success", before).value == pytest.approx(7 / 8 - 1 / 8)
    assert after.mean("success").value == pytest.approx(7 / 8)


def test_what_is_the_same_at_every_start_has_no_spread():
    gain = trials(np.ones((3, 20))).gain("success", trials(np.zeros((3, 20))))
    assert gain == (1.0, 1.0, 1.0)


def test_starts_that_are_hard_for_both_do_not_widen_a_gain():
    rng = np.random.default_rng(0)
    hard = rng.normal(0, 5, 200)
    before, after = (trials(np.ones((1, 200)), hard + more) for more in (0.0, 1.0))
    gain = after.gain("reward", before)
    assert (gain.low, gain.high) == pytest.approx((1.0, 1.0))
    assert after.mean("reward").high - after.mean("reward").low > 1.0


def test_seeds_that_differ_widen_a_gain_by_what_a_mean_of_so_few_may_err():
    values = np.repeat([[0.0], [1.0], [0.0]], 50, axis=1)
    estimate = Estimate.of(values)
    assert estimate.value == pytest.approx(1 / 3)
    assert estimate.high - estimate.value == pytest.approx(4.303 / 3, rel=1e-3)  # Student's t of two degrees of freedom


def test_an_interval_of_a_success_rate_or_its_gain_ends_where_these_do():
    mixed, never = trials(np.repeat([[0], [1], [0]], 50, axis=1)), trials(np.zeros((3, 50)))
    assert (mixed.mean("success").low, mixed.mean("success").high) == (0.0, 1.0)
    assert mixed.gain("success", never).high == 1.0
    assert mixed.gain("success", never).low < 0.0


def test_a_seed_that_only_one_has_is_no_part_of_a_gain():
    before, after = trials([[0, 0], [0, 1]]), trials([[1, 1]])
    assert after.gain("success", before).value == 1.0
    assert np.isnan(after.gain("success", Trials((7,), *(np.ones((1, 2)),) * 3)).value)


@pytest.mark.parametrize("seeds", [1, 3, 8])
def test_an_interval_holds_the_truth_as_often_as_it_says(seeds):
    """Of means over seeds and starts; with a single seed where seeds are all alike."""
    rng = np.random.default_rng(1)
    of_seeds = 0.0 if seeds == 1 else 0.5
    ends = []
    for _ in range(500):
        of_starts, of_both = rng.normal(0, 1.0, 60), rng.normal(0, 0.5, (seeds, 60))
        ends.append(Estimate.of(0.3 + of_starts + rng.normal(0, of_seeds, (seeds, 1)) + of_both))
    assert 0.92 < np.mean([one.low < 0.3 < one.high for one in ends]) < 0.985


def test_only_gains_that_leave_out_zero_bear_a_star():
    figures = {f"{when}_{what}": 0.5 for when in ("before", "after") for what in ("success", "reward")}
    ends = {"success_gain": 0.1, "success_gain_low": -0.1, "success_gain_high": 0.3}
    sure = {"reward_gain": 0.2, "reward_gain_low": 0.1, "reward_gain_high": 0.3}
    unsure = {"reward_gain": 0.2, "reward_gain_low": -0.1, "reward_gain_high": 0.3}
    about = {"family": "rigid_body"}
    rows = pd.DataFrame([{**about, "hidden": "a", **figures, **ends, **one} for one in (sure, unsure)])
    table = gain_table("title", rows, {("rigid_body", "a"): "command delay"})
    assert list(table.marked) == [0]
    assert table.rows[0][:2] == ["rigid body: a", "command delay"]


SMALL = (
    "families=[formulas]",
    "hidden={delay: [{name: command_delay, delay_s: 0.3}]}",
    *(f"~hidden.{name}" for name in ("lag", "loss", "sag", "patch")),
    "lengths={runs: 24, steps: 30, reference_runs: 40}",
    "task.vehicles=2",
    "task.steps=40",
    "policy.steps=20",
    "policy.random_steps=5",
    "policy.critic_updates=5",
    "policy.worlds=2",
    "policy.layers=[8,8]",
    "rollouts=10",
    "evaluate_every=10",
    "scenes=5",
    "seeds=1",
    "processes=1",
)


def smallest(output, *changes):
    """Options of the smallest study there is, with changes."""
    with hydra.initialize_config_dir(str(config_folder()), version_base="1.3"):
        composed = hydra.compose("experiment/policy_gain", [*SMALL, f"output={output}", *changes])
    return Options.parse(OmegaConf.to_container(composed, resolve=True), "policy_gain")


@pytest.mark.end_to_end
def test_a_robot_is_recorded_diagnosed_and_its_policies_are_tried(tmp_path):
    output = tmp_path / "out"
    headline = run(smallest(output, "seeds=2", "processes=2"))
    table = pd.read_csv(output / "table.csv").set_index("hidden")
    assert list(table.index) == ["nothing", "delay"]
    metrics = json.loads((output / "metrics.json").read_text())["formulas"]
    assert "command delay" in metrics["delay"]["found"]
    tried = pd.read_csv(output / "trials.csv")
    means = tried.groupby(["hidden", "simulation"]).success.mean()
    assert table.loc["delay", "before_success"] == pytest.approx(means["delay", "as learned"])
    assert table.loc["delay", "after_success"] == pytest.approx(means["delay", "extended"])
    assert headline["success_gain"] == pytest.approx(table.loc["delay", "success_gain"])
    assert (output / "simulations" / "formulas" / "delay" / "simulation" / "model.yaml").exists()
    assert (output / "gains.png").exists()
    assert "nothing" in (output / "report.md").read_text()


@pytest.mark.parametrize(
    ("change", "words"),
    [
        ("families=[formula]", "families: no such family: 'formula'"),
        ("vehicles=[2]", "give 2 ids or more"),
        ("task.steps=5", "raise steps to"),
        ("rollouts=3", "too few for an interval"),
        ("+hidden.nothing=[{name: command_delay}]", "'nothing' names what is compared with"),
        ("+hidden.odd=[{name: command_dela}]", "command_delay"),
        ("robot=create", "robot 'create' has no stand-in"),
    ],
)
def test_what_cannot_be_done_is_refused_before_anything_is_recorded(tmp_path, change, words):
    with pytest.raises(UserError, match=words):
        run(smallest(tmp_path / "out", change))
    assert not (tmp_path / "out").exists()


def test_formulas_move_the_vehicles_that_are_driven_live_elsewhere():
    assert live_vehicles_of("formulas") is LiveVehicles
