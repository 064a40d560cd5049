import itertools
from dataclasses import replace

import numpy as np
import pytest
import yaml
from tiny_worlds import CONF, TASKS, moved, one_world, robot_named, task_named, world_of

from swarmtwin.errors import UserError
from swarmtwin.robot import Arena
from swarmtwin.world.task import config_class, task_config, task_kinds
from swarmtwin.world.tasks.formation import formation_offsets_mm


def test_every_kind_of_task_has_a_configuration():
    kinds = {yaml.safe_load((CONF / "task" / f"{name}.yaml").read_text())["kind"] for name in TASKS}
    assert kinds == set(task_kinds())


@pytest.mark.parametrize("name", TASKS)
def test_every_shipped_task_is_typed_in_full_and_plays(name):
    content = yaml.safe_load((CONF / "task" / f"{name}.yaml").read_text())
    assert content["name"] == name
    assert set(content) == set(config_class(content["kind"]).model_fields)
    task = task_named(name)
    world = world_of(task, worlds=4)
    step = world.step(np.tile(task.robot.command_high, (4, task.vehicles, 1)))
    assert step.observation.shape == (4, task.vehicles, len(task.observation_names))
    assert step.observation.dtype == np.float32
    assert len(set(task.observation_names)) == task.observation_size
    assert np.isfinite(step.observation).all()
    assert np.isfinite(step.reward).all()


@pytest.mark.parametrize("name", TASKS)
def test_scenes_begin_without_a_collision_inside_the_arena_and_away_from_the_target(name):
    task = task_named(name)
    scenario = task.draw(np.random.default_rng(1), 500)
    events = task.events(scenario, scenario.start)
    assert not events.collided.any()
    assert not events.left_arena.any()
    low, high = task.start_room_mm
    assert (scenario.start[..., :2] >= low).all()
    assert (scenario.start[..., :2] <= high).all()
    assert (np.abs(scenario.start[..., 2]) <= np.pi).all()
    assert not events.at_target.any()


@pytest.mark.parametrize("name", TASKS)
def test_the_same_seed_draws_the_same_scenes_and_another_seed_others(name):
    task = task_named(name)
    first, again, other = (task.draw(np.random.default_rng(seed), 5) for seed in (1, 1, 2))
    assert np.array_equal(first.start, again.start)
    assert np.array_equal(first.targets, again.targets, equal_nan=True)
    assert not np.array_equal(first.start, other.start)


def test_starts_are_uniform_headings_too():
    scenario = task_named("collective").draw(np.random.default_rng(3), 2000)
    assert np.abs(scenario.start[..., :2].mean(axis=(0, 1)) - 515).max() < 15
    assert abs(np.exp(1j * scenario.start[..., 2]).mean()) < 0.03


def test_targets_lie_in_the_inner_half_and_apart():
    collective = task_named("collective").draw(np.random.default_rng(1), 500)
    assert collective.targets.min() >= 1030 / 4
    assert collective.targets.max() <= 3 * 1030 / 4
    first, second = np.moveaxis(task_named("pair").draw(np.random.default_rng(1), 500).targets, 1, 0)
    assert np.hypot(*(second - first).T).min() >= 500


def test_the_obstacle_lies_across_the_way():
    task = task_named("obstacle")
    scenario = task.draw(np.random.default_rng(1), 500)
    start, target, centre = scenario.start[:, 0, :2], scenario.targets[:, 0], scenario.obstacles[:, 0, :2]
    way = target - start
    along = ((centre - start) * way).sum(axis=1) / (way**2).sum(axis=1)
    aside = np.abs(way[:, 0] * (centre - start)[:, 1] - way[:, 1] * (centre - start)[:, 0]) / np.hypot(*way.T)
    assert ((along > 0) & (along < 1)).all()
    assert (aside < scenario.obstacles[:, 0, 2]).all()
    assert (np.hypot(*(centre - target).T) > scenario.obstacles[:, 0, 2] + task.half_vehicle_mm).all()


@pytest.mark.parametrize(
    ("distances", "expected"),
    [
        ((149.9, 500.0), (-5.0, -20 * 500 / 1400)),
        ((150.0, 500.0), (-20 * 150 / 1400, -20 * 500 / 1400)),
        ((700.0, 1400.0), (-10.0, -20.0)),
        ((100.0, 0.0), (-10.0, -10.0)),
        ((300.0, 160.0), (-20 * 300 / 1400 - 5, -20 * 160 / 1400 - 5)),
        ((310.0, 160.0), (-20 * 310 / 1400, -20 * 160 / 1400)),
    ],
)
def test_equation_3_by_hand(distances, expected):
    """Two vehicles on the x axis at these distances from the target; nearer than 150 mm to each other costs 5."""
    task = task_named("collective", vehicles=2)
    pose = [(100.0 + distance, 500.0, 0.7) for distance in distances]
    scenario = one_world(task, pose, (100.0, 500.0))
    assert task.reward(scenario, scenario.start)[0] == pytest.approx(expected)


def test_equation_3_counts_every_near_neighbour_once_and_150_mm_is_not_near():
    task = task_named("collective", vehicles=4)
    pose = [(400.0, 500.0, 0.0), (500.0, 500.0, 0.0), (600.0, 500.0, 0.0), (750.0, 500.0, 0.0)]
    scenario = one_world(task, pose, (400.0, 900.0))
    target = -20 * np.hypot(np.array([0, 100, 200, 350]), 400) / 1400
    assert task.reward(scenario, scenario.start)[0] == pytest.approx(target - 5 * np.array([1, 2, 1, 0]))


def test_a_wall_costs_as_much_as_a_neighbour_where_walls_count():
    pose = [(150.0, 500.0, 0.0), (149.0, 700.0, 0.0), (500.0, 1000.0, 0.0)]
    earned = []
    for near in (0, 150):
        task = task_named("collective", vehicles=3, wall_near_mm=near)
        scenario = one_world(task, pose, (900.0, 500.0))
        earned.append(task.reward(scenario, scenario.start)[0])
        compiled = task.measure_compiled(scenario, scenario.start).reward[0]
        assert compiled == pytest.approx(earned[-1], abs=1e-4)
    assert earned[1] - earned[0] == pytest.approx([0, -5, -5])


def test_the_obstacles_reward_by_hand():
    task = task_named("obstacle")
    gone_wrong = one_world(task, [(300.0, 300.0, 0.0)], (300.0, 900.0), (300.0, 420.0, 80.0))
    near = one_world(task, [(300.0, 300.0, 0.0)], (300.0, 900.0), (300.0, 450.0, 80.0))
    reached = one_world(task, [(300.0, 300.0, 0.0)], (300.0, 380.0), (700.0, 450.0, 80.0))
    assert task.reward(gone_wrong, gone_wrong.start)[0, 0] == pytest.approx(-600 / 1400 - 0.5 - 5)
    assert task.reward(near, near.start)[0, 0] == pytest.approx(-600 / 1400 - 0.5)
    assert task.reward(reached, reached.start)[0, 0] == pytest.approx(1 - 80 / 1400)


def test_a_collision_is_nearer_than_100_mm_and_has_two_sides():
    task = task_named("collective", vehicles=3)
    for distance, collide in ((99.9, True), (100.0, False)):
        pose = [(300.0, 300.0, 0.0), (300.0 + distance, 300.0, 0.0), (700.0, 700.0, 0.0)]
        scenario = one_world(task, pose, (500.0, 500.0))
        assert task.collided(scenario, scenario.start)[0].tolist() == [collide, collide, False]


def test_the_obstacle_is_touched_at_half_a_vehicle_from_its_edge():
    task = task_named("obstacle")
    for distance, touches in ((124.9, True), (125.0, False)):
        scenario = one_world(task, [(300.0, 300.0, 0.0)], (900.0, 900.0), (300.0 + distance, 300.0, 80.0))
        assert task.collided(scenario, scenario.start)[0, 0] == touches


@pytest.mark.parametrize("name", ["collective", "formation", "obstacle"])
def test_what_is_seen_and_earned_does_not_depend_on_the_arenas_frame(name):
    task = task_named(name)
    scenario = task.draw(np.random.default_rng(5), 50)
    for shift, turn_rad in (((300.0, -80.0), 0.0), ((0.0, 0.0), np.pi / 2), ((-900.0, 40.0), 2.3)):
        other, pose = moved(scenario, scenario.start, shift, turn_rad)
        assert task.observe(other, pose) == pytest.approx(task.observe(scenario, scenario.start), abs=1e-6)
        assert task.reward(other, pose) == pytest.approx(task.reward(scenario, scenario.start))


def test_the_pool_looks_the_same_turned_by_half_a_turn_but_not_shifted():
    task = task_named("pair")
    scenario = task.draw(np.random.default_rng(5), 50)
    turned, pose = moved(scenario, scenario.start, (2000.0, 1000.0), np.pi)
    assert task.observe(turned, pose) == pytest.approx(task.observe(scenario, scenario.start), abs=1e-6)
    shifted, pose = moved(scenario, scenario.start, (100.0, 0.0))
    seen = np.abs(task.observe(shifted, pose) - task.observe(scenario, scenario.start)).max(axis=(0, 1))
    walls = [name.startswith("wall") for name in task.observation_names]
    assert seen[~np.array(walls)].max() < 1e-6
    assert seen[walls].min() > 0.01


@pytest.mark.parametrize("name", ["collective", "coverage", "pair"])
def test_which_neighbour_is_which_does_not_show(name):
    task = task_named(name) if name == "pair" else task_named(name, vehicles=4)
    scenario = task.draw(np.random.default_rng(7), 50)
    order = np.array([1, 0]) if name == "pair" else np.array([2, 0, 3, 1])
    permuted = scenario.start[:, order]
    assert np.array_equal(task.observe(scenario, permuted), task.observe(scenario, scenario.start)[:, order])
    assert task.reward(scenario, permuted) == pytest.approx(task.reward(scenario, scenario.start)[:, order])


@pytest.mark.parametrize(
    ("name", "changes", "message"),
    [
        ("collective", {"vehicles": 100}, "100 vehicles can never be within 250 mm of a target at once"),
        (
            "collective",
            {"vehicles": 50, "reach_mm": 350, "separation_mm": 150},
            "50 vehicles do not fit into the arena of 'mgr' with 150 mm between them: about ",
        ),
        ("collective", {"margin_mm": 515}, "a margin of 515 mm leaves no room in the arena of 'mgr'; lower margin_mm"),
        ("collective", {"steps": 20}, "it cannot reach every target from everywhere in its arena and hold it"),
        ("collective", {"collision_mm": 50}, "collision_mm 50 is less than the width of 'mgr', 84 mm"),
        ("collective", {"separation_mm": 90}, "separation_mm 90 is less than collision_mm 100"),
        ("collective", {"targets": 2, "targets_apart_mm": 900}, "lower targets_apart_mm to 364 or less"),
        ("formation", {"vehicles": 9, "shape": "line"}, "a line of 9 vehicles 200 mm apart is 1600 mm × 0 mm"),
        ("formation", {"spacing_mm": 90}, "spacing_mm 90 is less than collision_mm 100: vehicles in place would"),
        (
            "formation",
            {"vehicles": 200},
            "a wedge of 200 vehicles 200 mm apart is 28143 mm × 14142 mm and does not fit",
        ),
        ("coverage", {"vehicles": 2}, "2 vehicles that each cover 310 mm about them cover at most 57% of the arena"),
        ("coverage", {"vehicles": 200}, "200 vehicles do not fit into the arena of 'mgr' with 200 mm between them"),
        ("obstacle", {"distance_mm": 100}, "leaves no room for the obstacle"),
        ("obstacle", {"radius_mm": [60, 400]}, "an obstacle of 400 mm does not fit between start and target"),
    ],
)
def test_a_task_that_cannot_be_done_is_refused(name, changes, message):
    with pytest.raises(UserError) as error:
        task_named(name, **changes)
    assert message in str(error.value)
    assert str(error.value).startswith(f"task {name!r}: ")
    assert str(error.value).endswith(f"(conf/task/{name}.yaml)")


@pytest.mark.parametrize("name", TASKS)
def test_a_task_is_played_in_the_arena_that_is_stated(name):
    usual = task_named(name)
    wide = Arena(x=(-1000.0, 2000.0), y=(-500.0, 2500.0))
    changes = {"reach_mm": 1000} if name == "coverage" else {}
    task = task_named(name, arena=wide, steps=500, **changes)
    assert usual.arena == usual.robot.arena_mm
    scenario = task.draw(np.random.default_rng(1), 500)
    position = scenario.start[..., :2]
    assert position.min() >= -1000 + task.config.margin_mm
    assert position[..., 1].max() > usual.arena.high_mm[1]
    assert usual.events(scenario, scenario.start).left_arena.any()
    assert not task.events(scenario, scenario.start).left_arena.any()
    assert not task.lost(scenario.start).any()


def test_walls_are_those_of_the_stated_arena():
    pose = np.array([[(500.0, 500.0, 0.0), (900.0, 500.0, 0.0)]])
    near, far = (task_named("pair", arena=Arena(x=(0.0, x_mm), y=(0.0, 1000.0))) for x_mm in (1800.0, 2000.0))
    ahead = near.observation_names.index("wall_ahead_closeness")
    seen = [task.observe(one_world(task, pose[0], (100.0, 100.0)), pose)[0, 1, ahead] for task in (near, far)]
    assert seen == pytest.approx(np.exp([-900 / 250, -1100 / 250]))


def test_a_task_for_another_size_of_robot_is_refused():
    with pytest.raises(UserError, match="collision_mm 100 is less than the width of 'mur', 160 mm"):
        task_named("collective", robot=robot_named("mur"))


@pytest.mark.parametrize(
    ("content", "message"),
    [
        (
            {"kind": "colective"},
            "no such kind of task: 'colective': did you mean 'collective'? known: collective, ",
        ),
        ({"name": "collective"}, "x: field 'kind' is missing: it says which kind of task; known: collective, "),
        ({"vehicles": 1}, "x: field 'vehicles': Input should be greater than or equal to 2, got 1"),
        ({"reech_mm": 1}, "x: unknown field 'reech_mm': did you mean 'reach_mm'?"),
    ],
)
def test_a_wrong_configuration_is_refused(content, message):
    shipped = yaml.safe_load((CONF / "task" / "collective.yaml").read_text())
    whole = content if "name" in content else {**shipped, **content}
    with pytest.raises(UserError) as error:
        task_config(whole, "x")
    assert message in str(error.value)


def test_as_many_as_are_said_to_fit_do_fit():
    with pytest.raises(UserError) as error:
        task_named("collective", vehicles=40, reach_mm=300)
    fitting = int(str(error.value).split("about ")[1].split()[0])
    task = task_named("collective", vehicles=fitting, reach_mm=300)
    scenario = task.draw(np.random.default_rng(0), 20)
    assert scenario.start.shape == (20, fitting, 3)
    assert not task.collided(scenario, scenario.start).any()


def test_a_coverage_that_every_start_fulfils_is_refused():
    task = task_named("coverage", reach_mm=900)
    with pytest.raises(UserError, match="wherever the vehicles start, they cover enough already; lower reach_mm"):
        task.draw(np.random.default_rng(0), 3)


@pytest.mark.parametrize("name", ["formation", "coverage"])
def test_one_vehicle_alone_forms_and_covers(name):
    changes = {"covered": 0.25} if name == "coverage" else {}
    task = task_named(name, vehicles=1, **changes)
    scenario = task.draw(np.random.default_rng(0), 5)
    assert np.isfinite(task.observe(scenario, scenario.start)).all()
    assert not task.collided(scenario, scenario.start).any()


@pytest.mark.parametrize(("field", "value"), [("sees_nearest", -1), ("sees_within_mm", 0)])
def test_senses_that_nobody_can_have_are_refused(field, value):
    with pytest.raises(UserError, match=f"field '{field}': Input should be greater than"):
        task_named("formation", **{field: value})


@pytest.mark.parametrize("name", ["collective", "formation", "coverage"])
def test_five_and_fifty_vehicles_observe_the_same_numbers(name):
    large = Arena(x=(0.0, 3600.0), y=(0.0, 3600.0))
    local = {"sees_nearest": 4, "sees_within_mm": 400}
    reach = {"reach_mm": 700} if name == "collective" else {}
    shape = {"shape": "circle"} if name == "formation" else {}
    few = task_named(name, **local)
    many = task_named(name, vehicles=50, steps=400, arena=large, **local, **reach, **shape)
    assert few.observation_names == many.observation_names
    scenario = many.draw(np.random.default_rng(0), 2)
    assert many.observe(scenario, scenario.start).shape == (2, 50, few.observation_size)


@pytest.mark.parametrize("shape", ["line", "circle", "wedge"])
@pytest.mark.parametrize("vehicles", [1, 2, 5, 8])
def test_places_next_to_each_other_are_as_far_apart_as_told(shape, vehicles):
    offsets = formation_offsets_mm(shape, vehicles, 150.0, 30.0)
    between = np.hypot(*np.moveaxis(offsets[:, None] - offsets, -1, 0))
    between[np.arange(vehicles), np.arange(vehicles)] = np.inf
    assert offsets.shape == (vehicles, 2)
    assert vehicles == 1 or between.min(axis=1) == pytest.approx(np.full(vehicles, 150.0))


def test_a_line_stands_across_where_it_faces_and_a_wedge_points_there():
    line = formation_offsets_mm("line", 3, 100.0, 90.0)
    assert line[:, 1] == pytest.approx(np.zeros(3), abs=1e-9)
    assert sorted(line[:, 0]) == pytest.approx([-100, 0, 100])
    wedge = formation_offsets_mm("wedge", 3, 100.0, 90.0)
    assert wedge == pytest.approx(np.array([[0, 1], [-1, -1], [1, -1]]) * [70.71, 35.36], abs=0.01)


def test_places_go_to_the_vehicles_with_the_least_sum_of_squared_distances():
    task = task_named("formation", vehicles=4)
    scenario = task.draw(np.random.default_rng(2), 20)
    squared = (task.target_distance_mm(scenario, scenario.start) ** 2).sum(axis=1)
    for order in itertools.permutations(range(4)):
        other = replace(scenario, targets=scenario.targets[:, :, list(order)])
        assert (squared <= (task.target_distance_mm(other, scenario.start) ** 2).sum(axis=1) + 1e-6).all()


def test_which_vehicle_is_which_does_not_matter_to_a_formation():
    task = task_named("formation")
    scenario = task.draw(np.random.default_rng(7), 20)
    order = np.array([2, 0, 4, 3, 1])
    other = task.beginning(scenario.start[:, order], scenario.targets)
    assert np.array_equal(other.targets[:, 0], scenario.targets[:, 0, order])
    seen = task.observe(scenario, scenario.start)
    assert np.array_equal(task.observe(other, other.start), seen[:, order])


def test_the_formations_reward_by_hand():
    task = task_named("formation", vehicles=2, shape="line", facing_deg=90)
    pose = [(400.0, 500.0, 0.3), (540.0, 500.0, 0.0)]
    scenario = task.beginning(np.array([pose]), np.array([[(500.0, 500.0)]]))
    assert scenario.target[0].tolist() == pytest.approx(np.array([(400, 500), (600, 500)]))
    assert task.reward(scenario, scenario.start)[0] == pytest.approx([0.5 - 2.0, -0.06 - 2.0])
    assert task.events(scenario, scenario.start).at_target.tolist() == [[True, False]]


def test_the_covered_share_is_that_of_circles():
    """One vehicle in the middle of the arena, and one at its edge; the grid is fine enough for a few parts in 1000."""
    task = task_named("coverage", grid=200)
    pose = np.array([[(515.0, 515.0, 0.0)], [(515.0, 0.0, 1.0)]])
    circle = np.pi * 310**2 / 1030**2
    assert task.covered_share(pose) == pytest.approx([circle, circle / 2], abs=2e-3)


def test_two_vehicles_share_the_ground_at_the_line_between_them():
    task = task_named("coverage", vehicles=3, grid=200, reach_mm=5000)
    pose = np.array([[(257.5, 515.0, 0.0), (772.5, 515.0, 0.0), (257.5, 515.0, 0.0)]])
    middle = task.middle_of_own_ground(pose)[0]
    assert middle[:2] == pytest.approx(np.array([(257.5, 515.0), (772.5, 515.0)]))
    assert middle[2] == pytest.approx(pose[0, 2, :2])  # nothing is left to it


def test_going_to_the_middle_of_ones_own_ground_never_brings_the_ground_further_away():
    task = task_named("coverage", reach_mm=5000, covered=1.0)
    pose = np.concatenate([np.random.default_rng(3).uniform(100, 900, (30, 5, 2)), np.zeros((30, 5, 1))], axis=-1)

    def squared_mm(pose):
        away = np.hypot(*np.moveaxis(task.ground[:, None] - pose[:, None, :, :2], -1, 0)).min(axis=2)
        return (away**2).mean(axis=1)

    for _ in range(10):
        before = squared_mm(pose)
        pose[..., :2] = task.middle_of_own_ground(pose)
        assert (squared_mm(pose) <= before + 1e-6).all()


def test_the_coverages_reward_by_hand():
    task = task_named("coverage", vehicles=3, grid=1, covered=0.5)
    pose = np.array([[(515.0, 415.0, 0.0), (515.0, 295.0, 0.0), (100.0, 900.0, 0.0)]])
    scenario = one_world(task, pose[0], (np.nan, np.nan))
    assert task.ground.tolist() == [[515.0, 515.0]]
    assert task.reward(scenario, pose)[0] == pytest.approx([-0.5 - 0.5, -0.5 - 0.5, -0.5])
    assert task.events(scenario, pose).at_target.all()
