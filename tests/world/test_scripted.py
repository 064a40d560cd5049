"""Each task is solved by looking ahead in nominal kinematics, in vehicles that do not move quite so."""

import numpy as np
import pytest
import torch
from tiny_worlds import one_world, robot_named, simulation_of, task_named

from swarmtwin.errors import UserError
from swarmtwin.robot import Arena
from swarmtwin.world.motion import SimulatedMotion
from swarmtwin.world.rollout import play
from swarmtwin.world.scripted import ScriptedPolicy, candidate_commands, nominal_paths


def unlike_nominal(robot, seed, spread=0.15):
    """A simulation by the robot's kinematics whose every parameter is off its nominal value by some 15 %."""
    simulation = simulation_of(robot, "kinematic")
    model = next(module for module in simulation.dynamics.modules() if hasattr(module, "free"))
    nominal, rng = robot.kinematic_equations().nominal_values(robot), np.random.default_rng(seed)
    with torch.no_grad():
        for name, parameter in model.parameters_by_name.items():
            ratio = nominal[name] / parameter.size
            usual = ratio if parameter.signed else np.log(max(ratio, 1e-3))
            model.free[name].fill_(usual + rng.normal(0, spread))
    return simulation


def scripted_roll_out(task, worlds=50, seed=1):
    scenario = task.draw(np.random.default_rng(seed), worlds)
    motion = SimulatedMotion(unlike_nominal(task.robot, seed), worlds, task.vehicles)
    return play(task, motion, scenario, ScriptedPolicy(task).act)


@pytest.mark.parametrize(
    ("name", "changes"),
    [
        ("obstacle", {}),
        ("collective", {"steps": 70}),
        ("collective", {"steps": 70, "sees_nearest": 3, "sees_within_mm": 300}),
        ("formation", {"steps": 60}),
        ("coverage", {"steps": 60}),
        ("pair", {}),
    ],
)
def test_a_task_is_solved_by_looking_ahead(name, changes):
    assert scripted_roll_out(task_named(name, **changes)).success.mean() >= 0.9


def test_as_many_as_fifty_vehicles_form_a_circle():
    large = Arena(x=(0.0, 3600.0), y=(0.0, 3600.0))
    task = task_named("formation", arena=large, vehicles=50, shape="circle", steps=150)
    rollout = scripted_roll_out(task, worlds=1)
    assert rollout.success.all()


@pytest.mark.parametrize("name", ["obstacle", "collective", "pair"])
def test_commands_stay_within_the_limits_and_are_the_same_every_time(name):
    task = task_named(name)
    scenario = task.draw(np.random.default_rng(0), 20)
    seen = task.observe(scenario, scenario.start)
    command = ScriptedPolicy(task).act(seen)
    assert command.shape == (20, task.vehicles, len(task.robot.command))
    assert (command >= task.robot.command_low).all()
    assert (command <= task.robot.command_high).all()
    assert np.array_equal(ScriptedPolicy(task).act(seen), command)


def test_a_vehicle_in_place_rests_and_one_out_of_place_goes_there():
    task = task_named("formation", vehicles=1)
    policy = ScriptedPolicy(task)
    for heading_rad, direction in ((0.0, 1), (np.pi, -1)):
        in_place = one_world(task, [(500.0, 500.0, heading_rad)], (505.0, 500.0))
        assert policy.act(task.observe(in_place, in_place.start)).tolist() == [[[0, 0]]]
        out_of_place = one_world(task, [(300.0, 500.0, heading_rad)], (700.0, 500.0))
        left, right = policy.act(task.observe(out_of_place, out_of_place.start))[0, 0]
        assert left == right == direction * 120


def test_nominal_wheels_lead_where_the_equations_say():
    """At full effort 45 mm a period: a gain of 50 mm / 0.5 s / 120, less a dead band of 12; turning by 2 · 45 / 84."""
    robot = robot_named("mgr")
    paths = nominal_paths(robot, np.array([(120.0, 120.0), (-120.0, 120.0)]), 2)
    assert paths[0] == pytest.approx(np.array([(45, 0), (90, 0)]), abs=1e-4)
    assert paths[1] == pytest.approx(np.zeros((2, 2)), abs=1e-4)


def test_a_fin_to_the_left_leads_to_the_left():
    ahead, left, right = nominal_paths(robot_named("mur"), np.array([(0, 60, 9), (40, 60, 9), (-40, 60, 9)]), 3)
    assert ahead[-1, 1] == pytest.approx(0)
    assert left[-1, 1] > 20
    assert right[-1] == pytest.approx(left[-1] * (1, -1))


@pytest.mark.parametrize("name", ["mgr", "mur", "car", "create"])
def test_candidates_cover_the_limits_and_begin_with_rest(name):
    robot = robot_named(name)
    commands = candidate_commands(robot, 100)
    assert commands[0] == pytest.approx(robot.command_at_rest)
    assert commands.min(axis=0) == pytest.approx(robot.command_low)
    assert commands.max(axis=0) == pytest.approx(robot.command_high)


def test_a_task_that_shows_no_place_has_no_scripted_policy():
    task = task_named("collective")
    task.surrounding_names = task.surrounding_names[5:]
    with pytest.raises(UserError, match="task 'collective': its vehicles see no place to go to"):
        ScriptedPolicy(task)


def test_a_robot_without_kinematics_has_no_scripted_policy():
    robot = robot_named("mgr").model_copy(update={"kinematics": None})
    with pytest.raises(UserError, match="robot 'mgr' states no kinematics, and this needs some"):
        ScriptedPolicy(task_named("collective", robot=robot))
