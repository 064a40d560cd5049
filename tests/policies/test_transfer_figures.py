"""The figures of tables 5 and 6: what is found is what was planted."""

from dataclasses import replace

import numpy as np
import pytest

from swarmtwin.errors import UserError
from swarmtwin.policies.reward_plots import rewards_figure, success_figure
from swarmtwin.policies.rollout_comparison import metrics_of, reward_difference, rollout_table, tracked_figures
from swarmtwin.world.rollout import Rate, Rollout
from swarmtwin.world.rollout_storage import load_rollouts, save_rollouts
from swarmtwin.world.scenario import Scenario
from tiny_policies import robot_named, task_named

PERIODS, WORLDS, VEHICLES = 20, 40, 5


def rollouts(rewards, lasted=PERIODS):
    """Roll-outs whose mean rewards are given, (W,)."""
    worlds = len(rewards)
    pose = np.random.default_rng(0).uniform(0, 1000, (PERIODS + 1, worlds, VEHICLES, 3))
    counted = np.broadcast_to(np.arange(PERIODS)[:, None] < lasted, (PERIODS, worlds)).copy()
    nothing = np.zeros((PERIODS, worlds, VEHICLES), dtype=bool)
    return Rollout(
        robot=robot_named("mgr"),
        arena=robot_named("mgr").arena_mm,
        task=task_named("collective"),
        scenario=Scenario.beginning(pose[0], np.full((worlds, 1, 2), 500.0)),
        pose=pose,
        leg=np.zeros((PERIODS + 1, worlds), dtype=int),
        command=np.ones((PERIODS, worlds, VEHICLES, 2)),
        reward=np.where(counted[..., None], np.asarray(rewards)[:, None], 0.0) * np.ones(VEHICLES),
        counted=counted,
        collided=nothing,
        left_arena=nothing,
        at_target=nothing,
        reached=np.zeros((PERIODS, worlds), dtype=bool),
    )


def test_the_papers_difference_is_found():
    simulation, vehicles = rollouts(np.full(10, -3.13)), rollouts(np.full(10, -3.37))
    assert reward_difference(simulation, vehicles).percent == pytest.approx(-7.67, abs=0.01)
    assert str(reward_difference(simulation, vehicles)) == "-7.7 % (-7.7 to -7.7)"


def test_a_planted_difference_lies_in_its_interval_about_as_often_as_promised():
    rng, covered = np.random.default_rng(1), 0
    for seed in range(200):
        simulated = rng.normal(-3.0, 0.3, WORLDS)
        measured = 1.05 * simulated + rng.normal(0, 0.15, WORLDS)
        difference = reward_difference(rollouts(simulated), rollouts(measured), seed)
        covered += difference.low <= -5.0 <= difference.high
    assert 0.89 <= covered / 200 <= 0.99


def test_pairs_from_the_same_starts_make_the_interval_narrow():
    rng = np.random.default_rng(2)
    simulated = rng.normal(-3.0, 0.5, WORLDS)
    measured = simulated - 0.1
    paired = reward_difference(rollouts(simulated), rollouts(measured))
    mixed = reward_difference(rollouts(simulated), rollouts(rng.permutation(measured)))
    assert paired.high - paired.low < 0.2 * (mixed.high - mixed.low)


def test_too_few_rollouts_have_no_interval():
    few = rollouts(np.full(9, -3.0))
    with pytest.raises(UserError, match="9 roll-outs are too few for an interval: ask for 10 or more"):
        reward_difference(few, few)


def test_metrics_hold_both_sides_and_are_null_where_nothing_was_reached():
    both = {"simulation": rollouts(np.full(12, -2.0)), "stand_in": rollouts(np.full(12, -2.1))}
    metrics = metrics_of(both)
    assert metrics["simulation"]["reward"]["mean"] == pytest.approx(-2.0)
    assert metrics["stand_in"]["reach_time_s"] == {"mean": None, "sd": None}
    assert metrics["reward_difference_percent"]["value"] == pytest.approx(-5.0)
    assert tracked_figures(metrics)["reward_difference_percent"] == pytest.approx(-5.0)
    assert "reward_difference_percent" not in metrics_of({"simulation": both["simulation"]})


def test_every_moment_is_in_the_table_until_the_rollout_ended():
    table = rollout_table("stand_in", rollouts(np.full(3, -2.0), lasted=7))
    assert len(table) == 3 * VEHICLES * (7 + 1)
    assert list(table.columns[:4]) == ["world", "rollout", "vehicle", "time_s"]
    first = table[table.time_s == 0]
    assert first[["left", "right", "reward"]].isna().all(axis=None)
    assert not table[table.time_s > 0].isna().any(axis=None)
    assert table.time_s.max() == pytest.approx(3.5)
    one = rollouts(np.full(3, -2.0), lasted=7)
    row = table[(table.rollout == 2) & (table.vehicle == 4) & (table.time_s == 1.5)].iloc[0]
    assert row.x_mm == one.pose[3, 2, 3, 0]


def test_saved_rollouts_are_the_same_again_or_told_to_be_damaged(tmp_path):
    both = {"simulation": rollouts(np.full(12, -2.0), lasted=7), "stand_in": rollouts(np.full(12, -2.1))}
    file = tmp_path / "rollouts.npz"
    save_rollouts(file, both)
    for motion, loaded in load_rollouts(file).items():
        given = both[motion]
        assert (loaded.robot, loaded.arena, loaded.task) == (given.robot, given.arena, given.task)
        for name in ("pose", "reward", "counted", "success", "reach_time_s", "target_distance_mm"):
            np.testing.assert_array_equal(getattr(loaded, name), getattr(given, name))
    file.write_bytes(file.read_bytes()[:1000])
    with pytest.raises(UserError, match=r"rollouts\.npz: no roll-outs can be read"):
        load_rollouts(file)


def test_pictures_show_every_policy():
    pair = rollouts(np.linspace(-3, -2, 12)), rollouts(np.linspace(-3.2, -2.1, 12))
    figure = rewards_figure({"one": pair, "other": pair})
    assert [axes.get_title() for axes in figure.axes if axes.get_visible()] == ["one", "other"]
    assert np.allclose(figure.axes[0].collections[1].get_offsets()[:, 0], pair[0].mean_reward)
    rates = {"simulation": Rate(0.9, 0.8, 0.95), "stand_in": Rate(1.0, 0.96, 1.0)}
    bars = success_figure({"one": rates}).axes[0].patches
    assert [bar.get_width() for bar in bars] == [90, 100]


def test_the_table_tells_ended_from_going_on():
    shortened = rollouts(np.full(3, -2.0), lasted=7)
    assert replace(shortened, counted=np.ones_like(shortened.counted)).periods.tolist() == [PERIODS] * 3
    assert shortened.mean_reward.tolist() == pytest.approx([-2.0] * 3)
