"""Every vehicle of every world as a sub-environment of gymnasium, and of stable-baselines3 on top of it."""

import numpy as np
import pytest
from gymnasium.vector import AutoresetMode
from gymnasium.wrappers.vector import RecordEpisodeStatistics
from tiny_worlds import ExactMotion, one_world, robot_named, simulation_of, task_named, world_of

from swarmtwin.errors import UserError
from swarmtwin.policies.vector_env import SharedPolicyEnv
from swarmtwin.simulation.mechanism import mechanism_class
from swarmtwin.simulation.simulation import Simulation
from swarmtwin.world.motion import SimulatedMotion
from swarmtwin.world.vector_env import SwarmVectorEnv, vector_env

TASK = task_named("collective", vehicles=2, steps=60)


def env_of(task=TASK, worlds=3, seed=0):
    return SwarmVectorEnv(world_of(task, worlds, seed))


def random_commands(env, periods, seed=0):
    random = np.random.default_rng(seed)
    space = env.single_action_space
    return random.uniform(space.low, space.high, (periods, *env.action_space.shape))


def test_it_plays_what_the_world_plays():
    env, world = env_of(worlds=4), world_of(TASK, worlds=4)
    assert env.num_envs == 8
    seen, infos = env.reset(seed=5)
    world.reseed(5)
    assert np.array_equal(seen, world.reset().reshape(8, -1))
    assert infos == {}
    ends = 0
    for commands in random_commands(env, 130):
        observation, reward, terminated, truncated, infos = env.step(commands)
        step = world.step(commands.reshape(world.shape))
        assert np.array_equal(reward, step.reward.ravel())
        assert np.array_equal(terminated.reshape(4, 2), np.stack([step.terminated] * 2, axis=1))
        assert np.array_equal(truncated.reshape(4, 2), np.stack([step.truncated] * 2, axis=1))
        assert np.array_equal(observation, world.restart(step.ended).reshape(8, -1))
        assert ("final_obs" in infos) == step.ended.any()
        if step.ended.any():
            ends += 1
            assert np.array_equal(infos["final_obs"], step.observation.reshape(8, -1))
    assert ends >= 2


def test_spaces_are_those_of_a_vehicle_many_times():
    env = env_of(worlds=5)
    assert env.metadata["autoreset_mode"] is AutoresetMode.SAME_STEP
    assert env.action_space.shape == (10, 2)
    assert env.single_action_space.high.tolist() == [120, 120]
    seen, _ = env.reset()
    assert env.observation_space.contains(seen)
    assert env.observation_space.shape == (10, *env.single_observation_space.shape)


def test_infos_are_arrays_with_masks_and_what_has_ended_stands_apart():
    task = task_named("obstacle", steps=60)
    env = env_of(task, worlds=2)
    at_target, elsewhere = (
        one_world(task, [(place, place, 0.0)], (500.0, 500.0), (500.0, 900.0, 50.0)) for place in (500.0, 250.0)
    )
    both = np.zeros(2, dtype=int)
    scenario = at_target.where(both)
    scenario.put(np.array([1]), elsewhere)
    env.world.start(scenario)
    _, _, terminated, truncated, infos = env.step(np.zeros((2, 2)))
    assert terminated.tolist() == [True, False]
    assert not truncated.any()
    assert infos["_at_target"].tolist() == infos["_collided"].tolist() == [False, True]
    assert infos["at_target"].tolist() == [False, False]
    assert infos["_final_info"].tolist() == infos["_final_obs"].tolist() == [True, False]
    assert infos["final_info"]["at_target"].tolist() == infos["final_info"]["reached"].tolist() == [True, False]
    assert infos["final_info"]["_at_target"].tolist() == [True, False]
    assert set(env.step(np.zeros((2, 2)))[4]) == {
        *("collided", "left_arena", "at_target", "reached"),
        *("_collided", "_left_arena", "_at_target", "_reached"),
    }


def test_what_was_returned_is_not_changed_later():
    env = env_of(worlds=2)
    env.reset(seed=1)
    kept = env.step(np.full((4, 2), 90.0))[:4]
    copies = [part.copy() for part in kept]
    for commands in random_commands(env, 70, seed=1):
        env.step(commands)
    assert all(np.array_equal(part, copy) for part, copy in zip(kept, copies, strict=True))


def test_wrappers_of_gymnasium_count_returns_as_we_do():
    env = RecordEpisodeStatistics(env_of(worlds=3))
    env.reset(seed=0)
    rewards = []
    for commands in random_commands(env, 60):
        _, reward, _, truncated, infos = env.step(commands)
        rewards.append(reward)
    assert truncated.all()
    assert infos["episode"]["r"] == pytest.approx(np.sum(rewards, axis=0))
    assert infos["episode"]["l"].tolist() == [60] * 6


def test_the_same_seed_draws_the_same_motion_again():
    loss = mechanism_class("command_loss")(name="command_loss", probability=0.5)
    lossy = Simulation(simulation_of(TASK.robot, "mlp").dynamics, [loss]).eval()
    env = vector_env(TASK, lossy, worlds=3)
    assert env.world.motion.is_sampled
    played = []
    for seed in (4, 4, 5):
        env.reset(seed=seed)
        played.append([env.step(commands)[0] for commands in random_commands(env, 5)])
    assert np.array_equal(played[0], played[1])
    assert not np.array_equal(played[0], played[2])


def test_stable_baselines_sees_the_same_scaled():
    env, ours = SharedPolicyEnv(world_of(TASK, 3), reward_scale=2.0), env_of()
    space, shares = ours.single_action_space, np.random.default_rng(0).uniform(-1, 1, (60, 6, 2)).astype(np.float32)
    assert np.array_equal(env.reset(), ours.world.observe().reshape(6, -1))
    for share in shares:
        seen, reward, done, infos = env.step(share)
        commands = space.low + (space.high - space.low) * 0.5 * (share.astype(float) + 1)
        expected, expected_reward, terminated, truncated, told = ours.step(commands)
        assert np.array_equal(seen, expected)
        assert reward == pytest.approx(expected_reward / 2)
        assert np.array_equal(done, terminated | truncated)
    assert done.all()
    for row, info in enumerate(infos):
        assert info["TimeLimit.truncated"]
        assert np.array_equal(info["terminal_observation"], told["final_obs"][row])


def test_bad_input_is_one_clear_message():
    env = env_of()
    with pytest.raises(
        UserError, match=r"actions: shape \(2,\): give \(6, 2\), the columns of 'mgr' being left, right"
    ):
        env.step(np.zeros(2))
    with pytest.raises(UserError, match=r"actions: no array of numbers: give one of shape \(6, 2\)"):
        env.step([["fast", "slow"]] * 6)
    broken = np.zeros((6, 2))
    broken[3, 1] = np.nan
    with pytest.raises(
        UserError, match=r"world 1, vehicle 1, step 0: the command \(left, right\) is not finite: 0, nan"
    ):
        env.step(broken)
    with pytest.raises(UserError, match="the task is for robot 'mgr' and its motion is that of 'mur'"):
        vector_env(TASK, ExactMotion(robot_named("mur"), 3, 2), worlds=3)
    motion = SimulatedMotion(simulation_of(TASK.robot, "mlp"), 2, 2)
    with pytest.raises(
        UserError, match=r"this motion is of 2 × 2 vehicles .*, asked for are 3 × 2: make it with as many"
    ):
        vector_env(TASK, motion, worlds=3)
    with pytest.raises(UserError, match="this motion is of 2 worlds, commands are for 1: make it with as many"):
        vector_env(TASK, motion).step(np.zeros((2, 2)))
    with pytest.raises(UserError, match="0 worlds: ask for 1 or more"):
        vector_env(TASK, motion, worlds=0)
