"""One vehicle as a gymnasium environment, made by hand or by its id."""

import warnings

import gymnasium
import numpy as np
import pytest
from gymnasium.utils.env_checker import check_env, check_reset_seed_determinism, check_step_determinism
from gymnasium.wrappers import RescaleAction
from stable_baselines3.common.env_checker import check_env as check_env_of_stable_baselines
from tiny_worlds import TASKS, ExactMotion, robot_named, simulation_of, task_named, world_of

from swarmtwin.errors import UserError
from swarmtwin.simulation.mechanism import mechanism_class
from swarmtwin.simulation.simulation import Simulation
from swarmtwin.world.single_env import VehicleEnv, single_env

TASK = task_named("obstacle")
OBSTACLE = "swarmtwin.world.gymnasium_ids:swarmtwin/obstacle-v0"


def env_of(**options):
    return single_env(TASK, simulation_of(TASK.robot, "mlp"), **options)


def test_it_keeps_gymnasiums_contract():
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        for advice in ("Box observation space m.*imum value is", "we recommend using a symmetric", "not able to test"):
            warnings.filterwarnings("ignore", message=f".*{advice}")
        check_env(env_of())
        check_env(env_of(render_mode="rgb_array"))
        check_env_of_stable_baselines(RescaleAction(env_of(), np.float32(-1), np.float32(1)))


def test_drawn_motion_too_is_the_same_again_with_the_same_seed():
    bare = simulation_of(TASK.robot, "mlp")
    loss = mechanism_class("command_loss")(name="command_loss", probability=0.5)
    env = single_env("obstacle", Simulation(bare.dynamics, [loss]).eval())
    check_step_determinism(env)
    check_reset_seed_determinism(env)


def test_it_plays_what_the_world_plays_until_the_end():
    env, world = VehicleEnv(world_of(TASK, worlds=1)), world_of(TASK, worlds=1)
    world.reseed(2)
    seen, info = env.reset(seed=2)
    assert np.array_equal(seen, world.reset()[0, 0])
    assert info == {}
    random = np.random.default_rng(0)
    ended = False
    while not ended:
        command = random.uniform(-120, 120, 2)
        seen, reward, terminated, truncated, info = env.step(command)
        step = world.step(command[None, None])
        assert np.array_equal(seen, step.observation[0, 0])
        assert (reward, terminated, truncated) == (step.reward[0, 0], step.terminated[0], step.truncated[0])
        assert info["at_target"] == step.events.at_target[0, 0]
        ended = step.ended[0]
    with pytest.raises(ValueError, match="the roll-out has ended: reset the environment"):
        env.step(command)


@pytest.mark.parametrize("name", TASKS)
def test_every_task_has_an_id_for_one_vehicle_or_for_all(name):
    task = task_named(name)
    simulation = simulation_of(task.robot, "mlp")
    made = gymnasium.make_vec(
        f"swarmtwin.world.gymnasium_ids:swarmtwin/{name}-v0", 2 * task.vehicles, motion=simulation
    )
    assert made.num_envs == 2 * task.vehicles
    assert made.world.worlds == 2
    assert made.world.task.config == task.config


def test_an_id_makes_the_same_as_the_function():
    simulation = simulation_of(TASK.robot, "mlp")
    made, ours = gymnasium.make(OBSTACLE, motion=simulation), single_env("obstacle", simulation)
    assert isinstance(made.unwrapped, VehicleEnv)
    assert np.array_equal(made.reset(seed=3)[0], ours.reset(seed=3)[0])
    action = np.array([100, 50], dtype=np.float32)
    assert np.array_equal(made.step(action)[0], ours.step(action)[0])


def test_bad_input_is_one_clear_message():
    group = task_named("collective")
    with pytest.raises(
        UserError, match="'collective' is for 5 vehicles, a gymnasium environment for one: use parallel_env"
    ):
        single_env(group, simulation_of(group.robot, "mlp"))
    env = env_of()
    with pytest.raises(
        UserError, match=r"the action: shape \(3,\): give \(2,\), the columns of 'mgr' being left, right"
    ):
        env.step(np.zeros(3))
    with pytest.raises(UserError, match=r"the command \(left, right\) is not finite: nan, 0"):
        env.step(np.array([np.nan, 0.0]))
    with pytest.raises(UserError, match="no such render mode: 'human': known: rgb_array"):
        env_of(render_mode="human")
    with pytest.raises(UserError, match="the task is for robot 'mgr' and its motion is that of 'mur'"):
        single_env(TASK, ExactMotion(robot_named("mur"), 1, 1))
    with pytest.raises(UserError, match="no such task: 'obstcle': did you mean 'obstacle'"):
        single_env("obstcle", simulation_of(TASK.robot, "mlp"))
    made = "swarmtwin.world.gymnasium_ids:swarmtwin/collective-v0"
    with pytest.raises(UserError, match=r"num_envs=7: each world of task 'collective' has 5 vehicles.*a multiple of 5"):
        gymnasium.make_vec(made, 7, motion=simulation_of(group.robot, "mlp"))
