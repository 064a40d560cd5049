"""What is asked of real vehicles: obstacles must be told, and targets lie beside them."""

import numpy as np
import pytest

from swarmtwin.deploy.control.settings import SafetySettings
from swarmtwin.deploy.control.stop_conditions import StopConditions
from swarmtwin.errors import UserError
from swarmtwin.studies.deployed_policy import check_obstacles, scenario_for
from tiny_policies import robot_named, task_named

START = np.array([[200.0, 200.0, 0.0]])
OBSTACLE = (500.0, 500.0, 90.0)


@pytest.fixture
def task():
    return task_named("obstacle").build(robot_named("mgr"))


def test_a_task_with_an_obstacle_wants_to_be_told_where_it_stands(task):
    check_obstacles(task, [OBSTACLE])
    with pytest.raises(UserError, match=r"has 1 obstacles, 0 are told: say where they stand: obstacles=\[x, y, radius"):
        check_obstacles(task, [])
    with pytest.raises(UserError, match=r"\[500.0, 2000.0\] is not within the arena"):
        check_obstacles(task, [(500.0, 2000.0, 80.0)])


def test_an_obstacle_that_the_policy_never_met_is_told_of(task, caplog):
    check_obstacles(task, [(500.0, 500.0, 250.0)])
    assert "a radius from 60 to 100 mm, and this one has 250 mm" in caplog.text


def test_targets_that_are_drawn_lie_beside_the_obstacle_that_stands_there(task):
    touching_mm = 90.0 + max(task.robot.vehicle_size_mm) / 2
    away = []
    for seed in range(60):
        scenario = scenario_for(task, START, None, [OBSTACLE], seed)
        assert scenario.obstacles[0].tolist() == [[*OBSTACLE]]
        assert scenario.start[0].tolist() == START.tolist()
        away.append(np.hypot(*(scenario.targets[0, 0] - OBSTACLE[:2])))
    assert min(away) > touching_mm
    drawn = task.draw(np.random.default_rng(1), 1000).targets[:, 0]
    assert np.hypot(*(drawn - OBSTACLE[:2]).T).min() < touching_mm  # so that this was not by chance


def test_a_target_that_cannot_be_reached_without_touching_is_refused(task):
    with pytest.raises(UserError, match="no vehicle can be there without touching the obstacle"):
        scenario_for(task, START, [560.0, 500.0], [OBSTACLE], 1)
    assert scenario_for(task, START, [800.0, 500.0], [OBSTACLE], 1).targets.tolist() == [[[800.0, 500.0]]]


def test_a_vehicle_in_the_obstacle_is_a_reason_to_stop_and_one_beside_it_is_none(task):
    robot = task.robot
    conditions = StopConditions(robot, robot.arena_mm, ("1",), SafetySettings(), 90.0, np.array([OBSTACLE]))
    contact_mm = 90.0 + max(robot.vehicle_size_mm) / 2
    assert conditions.of_positions(np.array([[500.0 - contact_mm, 500.0]])) is None
    said = conditions.of_positions(np.array([[500.0, 400.0]]))
    assert said == "vehicle 1 is in the obstacle at x 500, y 500 mm"


def test_a_formation_is_formed_about_the_target_told_by_those_that_stand_there():
    task = task_named("formation", vehicles=3, shape="line", facing_deg=90).build(robot_named("mgr"))
    start = np.array([(800.0, 300.0, 0.0), (200.0, 300.0, 0.0), (500.0, 300.0, 0.0)])
    scenario = scenario_for(task, start, [500.0, 700.0], [], 1)
    assert scenario.targets[0, 0] == pytest.approx(np.array([(700.0, 700.0), (300.0, 700.0), (500.0, 700.0)]))
    drawn = scenario_for(task, start, None, [], 1).targets[0, 0]
    assert np.argsort(drawn[:, 0]).tolist() == [1, 2, 0]


def test_a_task_without_a_target_is_told_none():
    task = task_named("coverage", vehicles=4).build(robot_named("mgr"))
    start = np.array([(100.0 + 200 * index, 500.0, 0.0) for index in range(4)])
    assert np.isnan(scenario_for(task, start, None, [], 1).targets).all()
    with pytest.raises(UserError, match="target: task 'coverage' has no target: leave target= out"):
        scenario_for(task, start, [500.0, 500.0], [], 1)
