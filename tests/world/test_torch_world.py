"""Worlds in tensors: the same numbers as in arrays, and on the CPU the same memory."""

import numpy as np
import pytest
import torch
from tiny_worlds import ExactMotion, robot_named, simulation_of, task_named, world_of

from swarmtwin.errors import UserError
from swarmtwin.world.torch_world import TorchWorld, torch_world

TASK = task_named("collective", vehicles=3, steps=60)
DEVICES = ["cpu", pytest.param("cuda", marks=pytest.mark.skipif(not torch.cuda.is_available(), reason="no GPU"))]


@pytest.mark.parametrize("device", DEVICES)
def test_it_plays_what_the_world_plays(device):
    tensors, world = TorchWorld(world_of(TASK, worlds=4), device), world_of(TASK, worlds=4)
    world.reseed(7)
    assert np.array_equal(tensors.reset(seed=7).cpu(), world.reset())
    random = torch.Generator().manual_seed(0)
    for _ in range(70):
        command = 300 * torch.rand(4, 3, 2, generator=random) - 150
        told, step = tensors.step(command.to(device)), world.step(command.double().numpy())
        assert {part.device.type for part in told} == {device}
        assert np.array_equal(told.observation.cpu(), step.observation)
        assert np.array_equal(told.reward.cpu(), step.reward.astype(np.float32))
        assert np.array_equal(told.terminated.cpu(), step.terminated)
        assert np.array_equal(told.truncated.cpu(), step.truncated)
        assert np.array_equal(told.ended.cpu(), step.ended)
        assert np.array_equal(tensors.restart(told.ended).cpu(), world.restart(step.ended))


def test_on_the_cpu_observations_share_the_worlds_memory():
    class Kept(type(world_of(TASK))):
        def step(self, command):
            self.last = super().step(command)
            return self.last

    world = Kept(TASK, ExactMotion(TASK.robot, 2, 3), 2, 0)
    told = TorchWorld(world).step(torch.zeros(2, 3, 2))
    assert told.observation.data_ptr() == world.last.observation.ctypes.data
    assert told.terminated.data_ptr() == world.last.terminated.ctypes.data


def test_commands_of_a_network_with_gradients_are_taken():
    tensors = torch_world("collective", simulation_of(TASK.robot, "mlp"), worlds=2)
    command = torch.ones(2, 5, 2, requires_grad=True) * 50
    assert tensors.step(command).observation.shape == (2, 5, tensors.world.task.observation_size)


def test_bad_input_is_one_clear_message():
    tensors = TorchWorld(world_of(TASK, worlds=2))
    with pytest.raises(
        UserError, match=r"commands: shape \(6, 2\): give \(2, 3, 2\), the columns of 'mgr' being left, ri"
    ):
        tensors.step(torch.zeros(6, 2))
    broken = torch.zeros(2, 3, 2)
    broken[1, 2, 0] = torch.inf
    with pytest.raises(UserError, match="world 1, vehicle 2, step 0: the command"):
        tensors.step(broken)
    with pytest.raises(UserError, match="the task is for robot 'mgr' and its motion is that of 'mur'"):
        torch_world(TASK, ExactMotion(robot_named("mur"), 2, 3), worlds=2)
