import warnings

import numpy as np
import pytest
from pettingzoo.test import api_test, parallel_api_test, parallel_seed_test, render_test
from pettingzoo.utils import parallel_to_aec
from tiny_worlds import TASKS, one_world, robot_named, simulation_of, task_named

from swarmtwin.errors import UserError
from swarmtwin.world.motion import SimulatedMotion
from swarmtwin.world.parallel_env import parallel_env


def env_of(name, **options):
    task = task_named(name)
    return parallel_env(task, SimulatedMotion(simulation_of(task.robot, "mlp"), 1, task.vehicles), **options)


@pytest.mark.parametrize("name", TASKS)
def test_it_keeps_pettingzoos_contract_without_a_warning(name):
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        parallel_api_test(env_of(name), num_cycles=200)
        parallel_seed_test(lambda: env_of(name), num_cycles=60)


def test_spaces_are_those_of_robot_and_task():
    env = env_of("pair")
    assert env.possible_agents == ["vehicle_0", "vehicle_1"]
    space = env.action_space("vehicle_1")
    assert space.low.tolist() == [-79, 0, 3]
    assert space.high.tolist() == [79, 60, 9]
    observations, _ = env.reset(seed=1)
    assert all(env.observation_space(agent).contains(seen) for agent, seen in observations.items())


def test_all_vehicles_end_together_when_the_time_is_up():
    env = env_of("collective")
    env.reset(seed=0)
    for count in range(1, 151):
        _, rewards, terminated, truncated, infos = env.step({agent: np.zeros(2) for agent in env.agents})
        assert set(rewards) == set(env.possible_agents)
        assert set(truncated.values()) == {count == 150}
        assert not any(terminated.values())
    assert env.agents == []
    with pytest.raises(ValueError, match="all vehicles have ended: reset the environment"):
        env.step({})
    assert set(infos["vehicle_4"]) == {"collided", "left_arena", "at_target", "reached"}


def test_a_collision_is_told_to_the_vehicles_concerned():
    env = env_of("collective")
    task = env.world.task
    pose = [(200.0, 200.0, 0.0), (240.0, 200.0, 0.0), (800.0, 200.0, 0.0), (200.0, 800.0, 0.0), (800.0, 800.0, 0.0)]
    env.world.start(one_world(task, pose, (500.0, 500.0)))
    *_, infos = env.step({agent: np.zeros(2) for agent in env.agents})
    assert [infos[agent]["collided"] for agent in env.possible_agents] == [True, True, False, False, False]


def test_it_is_rendered_where_that_is_asked_for():
    env = env_of("collective", render_mode="rgb_array")
    env.reset(seed=0)
    env.step({agent: np.zeros(2) for agent in env.agents})
    assert env.render().shape == (720, 674, 3)
    assert env_of("collective").render() is None


def test_it_keeps_pettingzoos_contract_in_turns_and_in_pictures():
    """PettingZoo's test of pictures asks for a window first, for which there is no mode."""

    def in_turns(render_mode=None):
        return parallel_to_aec(env_of("pair", render_mode=None if render_mode == "human" else render_mode))

    with warnings.catch_warnings():
        warnings.filterwarnings("ignore", message="Agent's m.*imum observation space value is")
        api_test(in_turns(), num_cycles=50)
    render_test(in_turns)


def test_misuse_is_named():
    with pytest.raises(UserError, match="no such render mode: 'rgb_aray': did you mean 'rgb_array'"):
        env_of("collective", render_mode="rgb_aray")
    with pytest.raises(UserError, match="the task is for robot 'mgr' and its motion is that of 'mur'"):
        parallel_env(task_named("collective"), SimulatedMotion(simulation_of(robot_named("mur"), "mlp"), 1, 5))
    with pytest.raises(UserError, match="no such task: 'colective': did you mean 'collective'"):
        parallel_env("colective", SimulatedMotion(simulation_of(robot_named("mgr"), "mlp"), 1, 5))
    env = env_of("pair")
    with pytest.raises(ValueError, match="no action for vehicle_1"):
        env.step({"vehicle_0": np.zeros(3)})
    idle = {"vehicle_0": np.zeros(3), "vehicle_1": np.zeros(3)}
    with pytest.raises(
        UserError, match=r"vehicle_1: shape \(2,\): give \(3,\), the columns of 'mur' being mean_angle_deg"
    ):
        env.step({**idle, "vehicle_1": np.zeros(2)})
    with pytest.raises(UserError, match=r"world 0, vehicle 1, step 0: the command .* is not finite: 0, nan, 3"):
        env.step({**idle, "vehicle_1": np.array([0.0, np.nan, 3.0])})
