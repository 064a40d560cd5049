"""How fast groups are stepped beside the environments of others, in one run: `pytest -s -m benchmark_figures`.

Each side is stepped by its own standard interface, on one thread, with five vehicles that each see all others. Theirs
are the particles of `simple_spread`, in which there is no learned model.
"""

import time

import pytest
import torch
import yaml

from swarmtwin.configuration import config_folder
from swarmtwin.dynamics.model_config import config_class
from swarmtwin.dynamics.predictor import NetworkDynamics
from swarmtwin.simulation.displacement_table import TableSettings
from swarmtwin.simulation.simulation import Simulation
from swarmtwin.world.parallel_env import parallel_env
from swarmtwin.world.task import task_config
from swarmtwin.world.torch_world import torch_world

MEASURED_S = 1.0
VEHICLES = 5


@pytest.fixture
def one_thread():
    threads = torch.get_num_threads()
    torch.set_num_threads(1)
    yield
    torch.set_num_threads(threads)


@pytest.fixture
def group(robots):
    """The task of five vehicles, and a simulation by an untrained network."""
    content = yaml.safe_load((config_folder() / "task" / "collective.yaml").read_text())
    task = task_config(content, "collective.yaml").build(robots["mgr"])
    return task, Simulation(NetworkDynamics(task.robot, config_class("mlp")()).eval())


def steps_per_s(actions, step):
    """How often a second a step is done, with some actions in turn."""
    step(actions[0])
    count, start = 0, time.perf_counter()
    while time.perf_counter() - start < MEASURED_S:
        step(actions[count % len(actions)])
        count += 1
    return count / (time.perf_counter() - start)


def parallel_rate(env):
    """Vehicle-steps a second of a PettingZoo parallel environment, new starts included."""
    env.reset(seed=0)
    actions = [{agent: env.action_space(agent).sample() for agent in env.possible_agents} for _ in range(20)]

    def step(action):
        env.step(action)
        if not env.agents:
            env.reset()

    return steps_per_s(actions, step) * len(env.possible_agents)


def tensor_rate(world):
    """Vehicle-steps a second of a world in tensors, new starts included."""
    robot, shape = world.world.robot, world.world.shape
    low, high = torch.from_numpy(robot.command_low), torch.from_numpy(robot.command_high)
    commands = [low + (high - low) * torch.rand(*shape) for _ in range(20)]

    def step(command):
        stepped = world.step(command)
        world.restart(stepped.ended, stepped.observation)

    return steps_per_s(commands, step) * shape[0] * shape[1]


def report(what, ours, peer, theirs):
    print(f"\n{what}: {ours:,.0f} vehicle-steps/s; {peer} {theirs:,.0f}; ours are {ours / theirs:.2f} times theirs")


@pytest.mark.benchmark_figures
@pytest.mark.usefixtures("one_thread")
def test_one_world_beside_mpe(group):
    reason = "mpe2 cannot be imported: pip install mpe2"
    peer = pytest.importorskip("mpe2.simple_spread_v3", reason=reason, exc_type=ImportError)
    theirs = parallel_rate(peer.parallel_env(N=VEHICLES, max_cycles=150, continuous_actions=True))
    ours = parallel_rate(parallel_env(*group))
    report(f"PettingZoo, one world of {VEHICLES}", ours, "MPE", theirs)
    assert min(ours, theirs) > 0


@pytest.mark.benchmark_figures
@pytest.mark.usefixtures("one_thread")
@pytest.mark.parametrize("worlds", [1, 100, 1000])
def test_many_worlds_beside_vmas(group, worlds):
    vmas = pytest.importorskip("vmas", reason="vmas cannot be imported: pip install vmas", exc_type=ImportError)
    peer = vmas.make_env("simple_spread", num_envs=worlds, device="cpu", seed=0, n_agents=VEHICLES)
    actions = [peer.get_random_actions() for _ in range(20)]
    theirs = steps_per_s(actions, peer.step) * worlds * VEHICLES
    network = tensor_rate(torch_world(*group, worlds=worlds))
    table = tensor_rate(torch_world(*group, worlds=worlds, table=TableSettings(position_mm=1e3, heading_deg=1e3)))
    report(f"tensors, {worlds} worlds of {VEHICLES}, a network moves them", network, "VMAS", theirs)
    report(f"tensors, {worlds} worlds of {VEHICLES}, its table moves them", table, "VMAS", theirs)
    assert min(network, table, theirs) > 0
