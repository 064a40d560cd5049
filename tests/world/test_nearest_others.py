import numpy as np
import pytest
from tiny_worlds import task_named, world_of

from swarmtwin.world.neighbours import between_vehicles_mm, nearest_others, others_nearer_than


def crowd(worlds, vehicles, seed=0, side_mm=1000.0):
    """Poses anywhere in a square, the worlds in the same one."""
    return np.random.default_rng(seed).uniform(0, side_mm, (worlds, vehicles, 3))


@pytest.mark.parametrize("within_mm", [np.inf, 250.0, 1.0])
@pytest.mark.parametrize(("worlds", "vehicles", "count"), [(1, 50, 4), (7, 30, 29), (3, 2, 5), (4, 1, 3), (2, 30, 0)])
def test_a_tree_finds_the_same_neighbours_as_all_pairs(worlds, vehicles, count, within_mm):
    pose = crowd(worlds, vehicles)
    plain = nearest_others(pose, count, within_mm, all_pairs_up_to=vehicles)
    by_tree = nearest_others(pose, count, within_mm, all_pairs_up_to=0)
    assert plain.distance_mm.shape == (worlds, vehicles, min(count, vehicles - 1))
    assert np.array_equal(by_tree.distance_mm, plain.distance_mm)
    is_there = np.isfinite(plain.distance_mm)
    assert np.array_equal(by_tree.number[is_there], plain.number[is_there])


def test_vehicles_in_the_very_same_place_are_each_others_neighbours():
    pose = np.zeros((2, 30, 3))
    pose[:, 3:, 0] = 500.0 + 10.0 * np.arange(27)
    for all_pairs_up_to in (0, 100):
        found = nearest_others(pose, 2, all_pairs_up_to=all_pairs_up_to)
        assert found.number[:, :3].tolist() == [[[1, 2], [0, 2], [0, 1]]] * 2
        assert not found.distance_mm[:, :3].any()


def test_a_tree_counts_the_same_near_others_as_all_pairs_and_at_the_radius_is_not_near():
    pose = crowd(5, 60)
    expected = (between_vehicles_mm(pose) < 130.0).sum(axis=-1)
    assert expected.max() > 3
    assert np.array_equal(others_nearer_than(pose, 130.0, all_pairs_up_to=0), expected)
    assert np.array_equal(others_nearer_than(pose, 130.0, all_pairs_up_to=60), expected)
    line = np.zeros((1, 30, 3))
    line[0, :, 0] = 100.0 * np.arange(30)
    for all_pairs_up_to in (0, 30):
        assert not others_nearer_than(line, 100.0, all_pairs_up_to).any()
        assert others_nearer_than(line, 100.1, all_pairs_up_to)[0].tolist() == [1, *[2] * 28, 1]


def test_a_large_group_meets_the_same_events_as_in_small_ones():
    """Two groups of 15 far from each other, as one of 30: what all pairs say of each, the tree says of both."""
    room = {"separation_mm": 100, "reach_mm": 300, "sees_nearest": 4, "sees_within_mm": 400}
    small = world_of(task_named("collective", vehicles=15, **room), worlds=2).task
    large = task_named("collective", vehicles=30, margin_mm=0, **room)
    near = crowd(1, 15, seed=1, side_mm=700.0)
    both = np.concatenate([near, near + np.array([5000.0, 0.0, 0.0])], axis=1)
    target = np.full((1, 1, 2), 500.0)
    alone, together = (task.beginning(pose, target) for task, pose in ((small, near), (large, both)))
    assert small.collided(alone, near).any()
    assert np.array_equal(large.collided(together, both), np.tile(small.collided(alone, near), 2))
    assert np.array_equal(large.reward(together, both)[:, :15], small.reward(alone, near))
    seen = large.observe(together, both)[..., 5:]
    assert np.array_equal(seen, np.tile(small.observe(alone, near)[..., 5:], (1, 2, 1)))
