import numpy as np
import pytest
from scipy.stats import binomtest
from tiny_worlds import Scripted, Still, one_world, task_named, world_of

from swarmtwin.world.rollout import NEVER, Rate, figures_of, roll_out
from swarmtwin.world.world import World


def drive(seed=0):
    """A policy that looks at what is seen and is noisy about it; its noise comes from the seed."""
    random = np.random.default_rng(seed)

    def act(observation):
        turn = 60 * observation[..., 3:4] + random.normal(0, 30, (*observation.shape[:2], 1))
        return np.concatenate([60 - turn, 60 + turn], axis=-1)

    return act


def scripted_roll_out(task, path, target, obstacle=None):
    """What is recorded of one vehicle or group that goes through poses (T, K, 3) after its start, the first of them."""
    path = np.array(path, dtype=float)
    filled = np.concatenate([path[1:], np.repeat(path[-1:], task.steps, axis=0)])[: task.steps]
    world = World(task, Scripted(task.robot, filled[:, None]), 1, 0)
    world.start(one_world(task, path[0], target, obstacle))
    return roll_out(world, lambda observation: np.zeros(world.shape))


def group_at(*distances):
    return [(515.0 - distances[0], 515.0, 0.0), (515.0 + distances[1], 515.0, 0.0)]


def test_a_roll_out_records_what_the_world_did():
    task = task_named("collective")
    rollout = roll_out(world_of(task, worlds=3, seed=2), drive())
    world = world_of(task, worlds=3, seed=2)
    assert rollout.pose.shape == (task.steps + 1, 3, 5, 3)
    assert np.array_equal(rollout.pose[0], rollout.scenario.start)
    for command, pose, reward in zip(rollout.command, rollout.pose[1:], rollout.reward, strict=True):
        step = world.step(command)
        assert np.array_equal(world.pose, pose)
        assert np.array_equal(step.reward, reward)
    lasted = [rollout.reward[:periods, world].mean() for world, periods in enumerate(rollout.periods)]
    assert rollout.mean_reward == pytest.approx(lasted)


def test_the_same_scenes_played_again_give_the_same_roll_out():
    task = task_named("collective")
    first = roll_out(world_of(task, seed=1), drive())
    other = world_of(task, seed=77)
    other.start(first.scenario)
    assert np.array_equal(roll_out(other, drive()).pose, first.pose)


def test_a_world_that_has_been_played_is_not_rolled_out():
    world = world_of(task_named("collective"))
    world.step(np.zeros(world.shape))
    with pytest.raises(ValueError, match="the world has been played already: reset it, or start it in a scenario"):
        roll_out(world, drive())


def test_success_is_reached_without_a_collision_inside_the_arena():
    task = task_named("collective", vehicles=2, hold_s=1.0, steps=50)
    reached = scripted_roll_out(task, [group_at(300, 300), group_at(200, 200), group_at(200, 200)], (515, 515))
    assert reached.success.tolist() == [True]
    assert reached.reached_step.tolist() == [2]
    assert reached.reach_time_s.tolist() == [1.0]
    assert reached.final_distance_mm == pytest.approx([200])
    touched = scripted_roll_out(task, [group_at(300, 300), group_at(49, 49), group_at(200, 200)], (515, 515))
    assert touched.reached_step[0] == 2
    assert touched.collided_step[0] == 1
    late = scripted_roll_out(task, [group_at(300, 300), *[group_at(200, 200)] * 9, group_at(40, 40)], (515, 515))
    assert (late.reached_step[0], late.collided_step[0]) == (2, 10)
    outside = [(-10.0, 515.0, 0.0), (700.0, 515.0, 0.0)]
    left = scripted_roll_out(task, [group_at(300, 300), outside, group_at(200, 200), group_at(200, 200)], (515, 515))
    assert (left.reached_step[0], left.left_step[0]) == (3, 1)
    away = scripted_roll_out(task, [group_at(300, 300), group_at(200, 200), group_at(200, 251)], (515, 515))
    assert away.reached_step[0] == NEVER
    assert np.isnan(away.reach_time_s[0])
    assert not any(rollout.success[0] for rollout in (touched, late, left, away))


def test_roll_outs_that_ended_early_stand_still_and_do_not_count_on():
    task = task_named("obstacle")
    rollout = roll_out(world_of(task, worlds=40, seed=3), drive())
    ended = rollout.periods < len(rollout.command)
    assert ended.any()
    for world in np.flatnonzero(ended):
        periods = rollout.periods[world]
        assert (rollout.pose[periods:, world] == rollout.pose[periods, world]).all()
        assert (rollout.reward[periods:, world] == 0).all()
        assert not rollout.collided[periods:, world].any()
        assert rollout.mean_reward[world] == pytest.approx(rollout.reward[:periods, world].mean())
        assert max(rollout.collided_step[world], rollout.reached_step[world], rollout.left_step[world]) <= periods


def test_some_roll_outs_of_many():
    rollout = roll_out(world_of(task_named("collective"), worlds=4), drive())
    some = rollout.where(np.array([3, 1]))
    assert len(some) == 2
    assert some.mean_reward == pytest.approx(rollout.mean_reward[[3, 1]])
    assert np.array_equal(some.target, rollout.target[:, [3, 1]])


@pytest.mark.parametrize(("happened", "count"), [(95, 100), (0, 10), (10, 10), (1, 2), (33, 47)])
def test_wilsons_interval_agrees_with_scipys(happened, count):
    expected = binomtest(happened, count).proportion_ci(method="wilson")
    rate = Rate.of(np.arange(count) < happened)
    assert rate == pytest.approx((happened / count, expected.low, expected.high))


def test_wilsons_interval_holds_the_true_rate_about_95_times_in_100():
    random = np.random.default_rng(0)
    for truth in (0.5, 0.9):
        held = [rate.low <= truth <= rate.high for rate in (Rate.of(random.random(60) < truth) for _ in range(2000))]
        assert 0.92 < np.mean(held) < 0.98


def test_figures_sum_up_over_roll_outs():
    rollout = roll_out(world_of(task_named("collective"), worlds=30, motion=Still), drive())
    figures = figures_of(rollout)
    assert figures.rollouts == 30
    assert figures.success.value == figures.collision.value == 0
    assert np.isnan(figures.reach_time_s)
    assert figures.reward == pytest.approx(rollout.reward.mean())
    assert figures.reward_sd == pytest.approx(rollout.reward.mean(axis=(0, 2)).std())
    distance = np.hypot(*np.moveaxis(rollout.scenario.start[..., :2] - rollout.scenario.targets, -1, 0)).max(axis=1)
    assert figures.final_distance_mm == pytest.approx(distance.mean())
