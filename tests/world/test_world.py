import numpy as np
import pytest
from tiny_worlds import TASKS, ExactMotion, Scripted, Still, one_world, robot_named, simulation_of, task_named, world_of

from swarmtwin.errors import UserError
from swarmtwin.world.motion import SimulatedMotion
from swarmtwin.world.scenario import Scenario
from swarmtwin.world.world import World

STEP_PARTS = ("observation", "reward", "command", "counted", "reached", "terminated", "truncated")


def commands(world, steps, seed=0):
    random = np.random.default_rng(seed)
    return random.uniform(world.robot.command_low, world.robot.command_high, (steps, *world.shape))


@pytest.mark.parametrize("name", TASKS)
def test_many_worlds_are_the_same_as_one_at_a_time_bit_for_bit(name):
    task = task_named(name)
    together = world_of(task, worlds=5)
    drives = commands(together, steps=task.steps)
    singles = [world_of(task, worlds=1) for _ in range(5)]
    for index, single in enumerate(singles):
        single.start(together.scenario.where(np.array([index])))
        assert np.array_equal(single.observe()[0], together.observe()[index])
    for drive in drives:
        step = together.step(drive)
        alone = [single.step(drive[index : index + 1]) for index, single in enumerate(singles)]
        for part in STEP_PARTS:
            assert np.array_equal(getattr(step, part), np.concatenate([getattr(one, part) for one in alone])), part
        assert np.array_equal(step.events.collided, np.concatenate([one.events.collided for one in alone]))
    assert together.ended.all()


def test_the_same_seed_plays_the_same_and_another_seed_otherwise():
    task = task_named("collective")
    first, again, other = (world_of(task, seed=seed) for seed in (4, 4, 5))
    for drive in commands(first, steps=20):
        steps = [world.step(drive) for world in (first, again, other)]
    assert np.array_equal(steps[0].observation, steps[1].observation)
    assert not np.array_equal(steps[0].observation, steps[2].observation)


def test_restarting_some_worlds_leaves_the_others():
    task = task_named("collective")
    world, reference = world_of(task, worlds=4), world_of(task, worlds=4)
    for drive in commands(world, steps=5):
        world.step(drive)
        last = reference.step(drive).observation
    seen = world.restart(np.array([False, True, False, True]))
    assert np.array_equal(seen[[0, 2]], last[[0, 2]])
    assert not np.isclose(seen[[1, 3]], last[[1, 3]]).all(axis=(1, 2)).any()
    assert world.step_count.tolist() == [5, 0, 5, 0]
    drive = commands(world, steps=1, seed=9)[0]
    step, expected = world.step(drive), reference.step(drive)
    assert np.array_equal(step.observation[[0, 2]], expected.observation[[0, 2]])
    assert np.array_equal(step.reward[[0, 2]], expected.reward[[0, 2]])


def test_restarting_none_changes_nothing():
    world = world_of(task_named("collective"))
    before, state = world.observe(), world.state()
    assert np.array_equal(world.restart(np.zeros(3, dtype=bool)), before)
    assert all(np.array_equal(value, state[name]) for name, value in world.state().items())


def test_time_runs_out_after_the_tasks_steps_and_ended_worlds_stand_still():
    task = task_named("collective", steps=45)
    world = world_of(task, worlds=2)
    drives = commands(world, steps=46)
    for drive in drives[:44]:
        assert not world.step(drive).ended.any()
    last = world.step(drives[44])
    assert last.truncated.all()
    assert last.counted.all()
    assert not last.terminated.any()
    after = world.step(drives[45])
    assert np.array_equal(after.observation, last.observation)
    assert not after.counted.any()
    assert not after.ended.any()
    assert (after.reward == 0).all()
    assert (after.command == 0).all()


def together(distances, target=(515.0, 515.0)):
    """Poses (2, 3) of two vehicles on either side of the target at these distances."""
    return [(target[0] - distances[0], target[1], 0.0), (target[0] + distances[1], target[1], np.pi)]


def played(task, distances):
    """Two vehicles that are at these distances from the target after each step: the world after them."""
    start = together((400.0, 400.0))
    poses = np.array([[together(pair)] for pair in distances])
    world = World(task, Scripted(task.robot, poses), 1, 0)
    world.start(one_world(task, start, (515.0, 515.0)))
    return world, [world.step(np.zeros(world.shape)) for _ in poses]


def test_reached_means_all_vehicles_at_once_for_long_enough_in_a_row():
    task = task_named("collective", vehicles=2, hold_s=1.5)
    assert task.hold_steps == 3
    near, far, only_one = (200.0, 250.0), (260.0, 260.0), (200.0, 260.0)
    _, steps = played(task, [near, near, only_one, near, near, far, near, near, near, far])
    assert [bool(step.reached[0]) for step in steps] == [False] * 8 + [True, True]
    assert not any(step.ended.any() for step in steps)


def test_the_next_target_follows_once_the_first_is_held():
    task = task_named("collective", vehicles=2, targets=2, hold_s=1.0, targets_apart_mm=0)
    poses = np.array([[together((200.0, 200.0))]] * 3 + [[together((200.0, 200.0), (315.0, 515.0))]] * 3)
    world = World(task, Scripted(task.robot, poses), 1, 0)
    targets = np.array([[(515.0, 515.0), (315.0, 515.0)]])
    world.start(Scenario.beginning(np.array([together((400.0, 400.0))]), targets))
    steps = [world.step(np.zeros(world.shape)) for _ in range(2)]
    assert world.scenario.leg.tolist() == [1]
    assert steps[1].reward[0] == pytest.approx(np.full(2, -20 * 200 / 1400))
    assert steps[1].observation[0, 0, 4] == pytest.approx(0 / 500, abs=1e-6)
    steps += [world.step(np.zeros(world.shape)) for _ in range(4)]
    assert [bool(step.reached[0]) for step in steps] == [False] * 4 + [True] * 2


def test_the_obstacle_task_ends_with_a_collision_or_with_the_target():
    task = task_named("obstacle")
    for place, collided in (((300.0, 400.0, 0.0), True), ((300.0, 840.0, 0.0), False)):
        world = World(task, Scripted(task.robot, np.array([[[place]]])), 1, 0)
        world.start(one_world(task, [(300.0, 150.0, 0.0)], (300.0, 900.0), (300.0, 500.0, 80.0)))
        step = world.step(np.zeros(world.shape))
        assert step.terminated[0]
        assert not step.truncated[0]
        assert step.collided[0] == collided
        assert step.reached[0] != collided


def test_leaving_the_arena_is_seen():
    task = task_named("obstacle", outside_mm=20)
    for x_mm, outside in ((1049.0, False), (1051.0, True), (-21.0, True)):
        world = World(task, Scripted(task.robot, np.array([[[(x_mm, 500.0, 0.0)]]])), 1, 0)
        assert world.step(np.zeros(world.shape)).left_arena[0] == outside


def test_a_roll_out_whose_vehicle_is_lost_stops_without_a_verdict():
    task = task_named("pair")
    for y_mm, lost in ((1490.0, False), (1510.0, True)):
        world = World(task, Scripted(task.robot, np.array([[[(500.0, 500.0, 0.0), (900.0, y_mm, 0.0)]]])), 1, 0)
        step = world.step(np.zeros(world.shape))
        assert step.left_arena[0]
        assert step.truncated[0] == lost
        assert not step.terminated[0]


def test_commands_are_cut_to_the_robots_limits():
    world = world_of(task_named("pair"), worlds=1)
    command = np.array([[[-100.0, 70.0, 0.0], [20.0, -5.0, 50.0]]])
    assert world.step(command).command.tolist() == [[[-79, 60, 3], [20, 0, 9]]]
    assert command[0, 0, 0] == -100


@pytest.mark.parametrize("value", [np.nan, np.inf, -np.inf])
def test_a_command_that_is_not_finite_is_refused(value):
    world = world_of(task_named("collective"))
    world.step(np.zeros(world.shape))
    command = np.full(world.shape, 7.0)
    command[2, 3, 1] = value
    before = world.pose.copy()
    with pytest.raises(UserError) as error:
        world.step(command)
    assert str(error.value) == (
        f"world 2, vehicle 3, step 1: the command (left, right) is not finite: 7, {value:g}; the policy is broken, "
        "train it anew"
    )
    assert np.array_equal(world.pose, before)


def test_an_ended_world_is_asked_for_no_command():
    task = task_named("collective", steps=45, vehicles=2)
    world = world_of(task, worlds=2)
    world.step_count[:] = (44, 0)
    world.step(np.zeros(world.shape))
    command = np.zeros(world.shape)
    command[0] = np.nan
    assert world.step(command).counted.tolist() == [False, True]


def test_a_pose_that_was_not_measured_is_refused():
    task = task_named("obstacle")
    world = World(task, Scripted(task.robot, np.full((1, 1, 1, 3), np.nan)), 1, 0)
    with pytest.raises(UserError, match=r"^world 0, vehicle 0, step 0: the pose \(mm, mm, rad\) is not finite: nan"):
        world.step(np.zeros(world.shape))


def test_commands_of_another_shape_are_a_programming_error():
    world = world_of(task_named("collective"))
    with pytest.raises(ValueError, match=r"commands of shape \(5, 2\) for worlds, vehicles, columns \(3, 5, 2\)"):
        world.step(np.zeros((5, 2)))
    with pytest.raises(ValueError, match=r"a scenario of starts \(2, 5, 3\) for 3 × 5 vehicles"):
        world.start(world.scenario.where(np.array([0, 1])))


def test_a_model_of_another_robot_is_refused():
    task, mur = task_named("collective"), robot_named("mur")
    with pytest.raises(UserError) as error:
        World(task, SimulatedMotion(simulation_of(mur, "mlp"), 1, 5), 1, 0)
    assert str(error.value) == (
        "the task is for robot 'mgr' and its motion is that of 'mur': give the dynamics model of 'mgr', or choose "
        "robot=mur"
    )


def test_a_model_of_the_robot_with_another_period_is_refused():
    task = task_named("collective")
    slower = task.robot.model_copy(update={"period_s": 0.6})
    with pytest.raises(UserError, match="'mgr' has other commands or another period here than in its dynamics"):
        World(task, ExactMotion(slower, 1, 5), 1, 0)


def test_a_checkpoint_continues_with_the_same_numbers():
    task = task_named("collective", steps=45)
    simulation = simulation_of(task.robot, "mlp", ("command", "previous_command", "earlier_command", "elapsed_s"))

    def play(world, drives):
        for drive in drives:
            step = world.step(drive)
            if step.ended.any():
                world.restart(step.ended)
        return world.observe()

    world = World(task, SimulatedMotion(simulation, 3, 5), 3, 0)
    world.step_count[:] = (0, 20, 40)
    drives = commands(world, steps=60)
    play(world, drives[:30])
    kept, kept_motion = world.state(), world.motion.state()
    expected = play(world, drives[30:])
    other = World(task, SimulatedMotion(simulation, 3, 5), 3, 99)
    other.motion.restore(kept_motion)
    other.restore(kept)
    assert np.array_equal(play(other, drives[30:]), expected)


def test_a_checkpoint_is_plain_arrays(tmp_path):
    world = world_of(task_named("pair"), motion=Still)
    np.savez(tmp_path / "state.npz", **world.state())
    with np.load(tmp_path / "state.npz", allow_pickle=False) as loaded:
        other = world_of(task_named("pair"), seed=8, motion=Still)
        other.motion.place(np.arange(3), loaded["pose"])
        assert np.array_equal(other.restore(dict(loaded)), world.observe())
    with pytest.raises(ValueError, match="does not fit"):
        world_of(task_named("pair"), worlds=2).restore(world.state())
