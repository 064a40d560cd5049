from dataclasses import replace

import numpy as np
import pytest
from tiny_worlds import one_world, robot_named, task_named

from swarmtwin.geometry import compose
from swarmtwin.world import observations

SCALING = observations.ObservationScaling()


@pytest.mark.parametrize("heading_rad", np.arange(-3, 4) * np.pi / 4)
def test_a_target_ahead_and_to_the_left_is_seen_there_at_every_heading(heading_rad):
    task = task_named("obstacle")
    pose = np.array([(400.0, 500.0, heading_rad)])
    for displacement, direction in (((200.0, 0, 0), (1, 0)), ((0, 150.0, 0), (0, 1)), ((-90.0, 0, 0), (-1, 0))):
        target = compose(pose[0], np.array(displacement))[:2]
        scenario = one_world(task, pose, target)
        seen = observations.observe_target(scenario, pose[None], SCALING)[0, 0]
        distance = np.hypot(*displacement[:2])
        assert seen == pytest.approx([*(distance / 500 * np.array(direction)), *direction, distance / 500])


@pytest.mark.parametrize("heading_rad", [0.0, np.pi / 2])
def test_a_displacement_moves_the_target_the_same_way_at_0_and_at_90_degrees(heading_rad):
    """The published environment turns by the same angle from body to arena and back, so (10, 3) comes out mirrored."""
    task = task_named("obstacle")
    before = np.array([[(400.0, 500.0, heading_rad)]])
    after = compose(before, np.array([[(10.0, 3.0, 0.0)]]))
    scenario = one_world(task, before[0], (700.0, 650.0))
    seen_before, seen_after = (
        observations.observe_target(scenario, pose, SCALING)[0, 0, :2] for pose in (before, after)
    )
    assert (seen_after - seen_before) * 500 == pytest.approx([-10, -3])


def test_neighbours_are_seen_in_the_vehicles_own_frame_nearest_first():
    pose = np.array([[(0.0, 0, np.pi / 2), (0, 150, np.pi), (-200, 0, 0)]])
    seen = observations.observe_neighbours(pose, contact_mm=100, scaling=SCALING)[0, 0].reshape(2, 5)
    assert seen[0] == pytest.approx([0.75, 0, np.exp(-0.5), 0, 1])
    assert seen[1] == pytest.approx([0, 1, np.exp(-1), 0, -1])


def test_beyond_sight_only_the_direction_counts():
    near = np.array([[(0.0, 0, 0), (400, 0, 0)]])
    far = np.array([[(0.0, 0, 0), (900, 0, 0)]])
    assert observations.observe_neighbours(near, 100, SCALING)[0, 0, :2] == pytest.approx([2, 0])
    assert observations.observe_neighbours(far, 100, SCALING)[0, 0, :2] == pytest.approx([2, 0])


def test_what_is_seen_of_a_neighbour_has_no_jump_where_it_goes_out_of_sight():
    distances = np.linspace(390, 410, 201)
    pose = np.zeros((201, 2, 3))
    pose[:, 1, 0] = distances
    seen = observations.observe_neighbours(pose, 100, SCALING)[:, 0]
    assert np.abs(np.diff(seen, axis=0)).max() < 1e-3


def test_the_nearest_alone_are_the_first_of_all():
    pose = np.random.default_rng(0).uniform(0, 1000, (20, 6, 3))
    everybody = observations.observe_neighbours(pose, 100, SCALING)
    for nearest in (0, 2, 5):
        seen = observations.observe_neighbours(pose, 100, SCALING, nearest)
        assert np.array_equal(seen, everybody[..., : 5 * nearest])


def test_where_nobody_is_in_sight_somebody_is_far_behind_and_not_close():
    pose = np.array([[(0.0, 0, 0), (200, 0, 0), (0, 301, 0)]])
    seen = observations.observe_neighbours(pose, 100, SCALING, nearest=4, within_mm=300)[0, 0].reshape(4, 5)
    assert seen[0] == pytest.approx([1, 0, np.exp(-1), 1, 0])
    assert seen[1:].tolist() == [[-2, 0, 0, 0, 0]] * 3
    alone = observations.observe_neighbours(pose[:, :1], 100, SCALING, nearest=1)
    assert alone.tolist() == [[[-2, 0, 0, 0, 0]]]


def test_at_the_edge_of_sight_somebody_is_seen():
    pose = np.array([[(0.0, 0, 0), (300, 0, 0)]])
    for within_mm, closeness in ((300, np.exp(-2)), (299.9, 0)):
        assert observations.observe_neighbours(pose, 100, SCALING, 1, within_mm)[0, 0, 2] == pytest.approx(closeness)


def test_walls_are_seen_in_eight_directions():
    arena = robot_named("mur").arena_mm
    seen = dict(
        zip(
            observations.WALL_DIRECTIONS,
            observations.observe_walls(np.array([[(300.0, 400, np.pi / 2)]]), arena, SCALING)[0, 0],
            strict=True,
        )
    )
    distance = {name: -np.log(value) * SCALING.wall_closeness_mm for name, value in seen.items()}
    expected = {"ahead": 600, "left": 300, "behind": 400, "right": 1700, "ahead_left": 300 * np.sqrt(2)}
    expected |= {"behind_left": 300 * np.sqrt(2), "behind_right": 400 * np.sqrt(2), "ahead_right": 600 * np.sqrt(2)}
    assert distance == pytest.approx(expected)


def test_at_and_beyond_the_wall_closeness_is_1():
    arena = robot_named("mur").arena_mm
    for x_mm in (2000.0, 2100.0):
        seen = observations.observe_walls(np.array([[(x_mm, 500, 0.0)]]), arena, SCALING)[0, 0]
        assert seen[0] == pytest.approx(1)
        assert seen[4] < 0.01


def test_the_nearest_obstacle_is_the_one_with_the_nearest_edge():
    task = task_named("obstacle")
    scenario = one_world(task, [(0.0, 0.0, 0.0)], (900.0, 0.0), (300.0, 0.0, 30.0))
    scenario = replace(scenario, obstacles=np.array([[(300.0, 0, 30), (0, 320, 100)]]))
    seen = observations.observe_obstacles(scenario, scenario.start, contact_mm=45, scaling=SCALING)[0, 0].reshape(2, 4)
    assert seen[0] == pytest.approx([0, 1.6, np.exp(-1.75), 0.5])
    assert seen[1] == pytest.approx([1.5, 0, np.exp(-2.25), 0.15])
