"""Vehicles that see their own last commands: those that were sent, and rest before the first."""

import numpy as np
import pytest
from tiny_worlds import ExactMotion, Still, one_world, robot_named, simulation_of, task_named, world_of

from swarmtwin.errors import UserError
from swarmtwin.world.motion import SimulatedMotion
from swarmtwin.world.parallel_env import parallel_env
from swarmtwin.world.past_commands import past_command_names
from swarmtwin.world.vector_env import vector_env
from swarmtwin.world.world import World


def shares(robot, command):
    """Commands (..., m) as shares −1…1 of the limits."""
    return 2 * (command - robot.command_low) / (robot.command_high - robot.command_low) - 1


def random_commands(world, count, seed=0):
    low, high = world.robot.command_low, world.robot.command_high
    return np.random.default_rng(seed).uniform(low, high, (count, *world.shape))


def test_columns_are_named_by_how_long_ago_they_were_sent():
    assert past_command_names(robot_named("mgr"), 2) == (
        "command_1_left",
        "command_1_right",
        "command_2_left",
        "command_2_right",
    )
    task = task_named("collective", sees_commands=2)
    blind = task_named("collective")
    assert task.observation_names == blind.observation_names + past_command_names(task.robot, 2)
    assert task.observation_size == blind.observation_size + 4


@pytest.mark.parametrize("compiled", [False, True])
@pytest.mark.parametrize("name", ["collective", "pair", "obstacle"])
def test_an_observation_ends_with_the_last_commands_and_is_else_as_ever(name, compiled):
    task, blind = task_named(name, sees_commands=3), task_named(name)
    robot, others = task.robot, blind.observation_size
    world, reference = (
        World(one, ExactMotion(robot, 3, one.vehicles), 3, 0, compiled=compiled) for one in (task, blind)
    )
    sent = [np.broadcast_to(robot.command_at_rest, world.shape)] * 3
    seen = world.observe()
    for command in random_commands(world, 5):
        assert seen[..., others:] == pytest.approx(np.concatenate(shares(robot, np.array(sent[:3])), axis=-1), abs=1e-6)
        assert np.array_equal(seen[..., :others], reference.observe())
        step, expected = world.step(command), reference.step(command)
        world.restart(step.ended, step.observation)
        reference.restart(expected.ended, expected.observation)
        assert np.array_equal(step.observation[..., :others], expected.observation)
        assert np.array_equal(step.observation[..., others:], world.observe()[..., others:])
        assert step.observation.dtype == np.float32
        sent.insert(0, command)
        seen = world.observe()
        if step.ended.any():
            break
    assert len(sent) > 4


def test_a_command_beyond_the_limits_is_seen_as_it_was_sent():
    world = world_of(task_named("collective", sees_commands=1))
    assert (world.step(np.full(world.shape, 500.0)).observation[..., -2:] == 1).all()


def test_a_robot_that_cannot_stop_has_been_at_rest_before_the_first_command():
    world = world_of(task_named("pair", sees_commands=1))
    robot = world.robot
    assert world.observe()[0, 0, -3:] == pytest.approx(shares(robot, robot.command_at_rest), abs=1e-6)


def test_worlds_that_start_anew_have_forgotten_and_others_have_not():
    world = world_of(task_named("collective", sees_commands=2))
    for command in random_commands(world, 2):
        last = world.step(command)
    seen = world.restart(np.array([False, True, False]), last.observation.copy())
    assert np.array_equal(seen, world.observe())
    assert (seen[1, :, -4:] == 0).all()
    assert np.array_equal(seen[[0, 2]], last.observation[[0, 2]])
    assert np.abs(seen[[0, 2], :, -4:]).min() > 0


def test_a_world_that_has_ended_goes_on_seeing_its_last_moment():
    world = world_of(task_named("collective", steps=45, sees_commands=2))
    world.step_count[:] = (44, 0, 0)
    drives = random_commands(world, 2)
    last, after = (world.step(command) for command in drives)
    assert last.ended.tolist() == [True, False, False]
    assert np.array_equal(after.observation[0], last.observation[0])
    assert after.observation[1, :, -2:] == pytest.approx(shares(world.robot, drives[0][1]), abs=1e-6)


def test_a_next_target_changes_nothing_of_past_commands():
    task = task_named("collective", vehicles=2, targets=2, hold_s=0.5, targets_apart_mm=0, sees_commands=1)
    world = world_of(task, worlds=1, motion=Still)
    world.start(one_world(task, [(415.0, 515.0, 0.0), (615.0, 515.0, 3.0)], (515.0, 515.0)))
    command = random_commands(world, 1)[0]
    step = world.step(command)
    assert world.scenario.leg.tolist() == [1]
    assert step.observation[..., -2:] == pytest.approx(shares(task.robot, command), abs=1e-6)


def test_a_world_continues_bit_for_bit_with_what_it_remembers():
    task = task_named("collective", sees_commands=3)
    world = world_of(task)
    drives = random_commands(world, 8)
    for command in drives[:4]:
        world.step(command)
    kept, pose = world.state(), world.pose
    expected = [world.step(command).observation for command in drives[4:]]
    other = world_of(task, seed=9)
    other.motion.place(np.arange(3), pose)
    other.restore(kept)
    assert all(
        np.array_equal(other.step(one).observation, seen) for one, seen in zip(drives[4:], expected, strict=True)
    )


def test_every_interface_shows_them():
    task = task_named("obstacle", sees_commands=1)
    simulation = simulation_of(task.robot, "mlp")
    env = parallel_env(task, SimulatedMotion(simulation, 1, 1), seed=0)
    env.reset(seed=0)
    command = np.array([60.0, -30.0], np.float32)
    seen, *_ = env.step({"vehicle_0": command})
    assert env.observation_space("vehicle_0").contains(seen["vehicle_0"])
    assert seen["vehicle_0"][-2:] == pytest.approx([0.5, -0.25])
    vehicles = vector_env(task, SimulatedMotion(simulation, 4, 1), worlds=4)
    vehicles.reset(seed=0)
    assert vehicles.step(np.tile(command, (4, 1)))[0][:, -2:] == pytest.approx(np.tile([0.5, -0.25], (4, 1)))


def test_a_negative_number_of_commands_is_refused():
    with pytest.raises(UserError, match="sees_commands"):
        task_named("collective", sees_commands=-1)
