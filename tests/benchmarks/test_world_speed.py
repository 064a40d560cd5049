"""How fast groups are simulated: figures to look at with `pytest -s -m benchmark_figures`."""

import multiprocessing
import time
from concurrent.futures import ThreadPoolExecutor
from functools import partial

import numpy as np
import pytest
import torch
import yaml

from swarmtwin.configuration import config_folder
from swarmtwin.dynamics.model_config import config_class, model_names
from swarmtwin.dynamics.predictor import NetworkDynamics
from swarmtwin.robot import Arena
from swarmtwin.simulation.displacement_table import TableSettings, tabulated
from swarmtwin.simulation.simulation import Simulation
from swarmtwin.world.compiled import fastest_motion
from swarmtwin.world.task import task_config
from swarmtwin.world.world import World

MEASURED_S = 1.0
LOOSE = TableSettings(position_mm=1e3, heading_deg=1e3)  # of an untrained network
PUBLISHED = 4_200
"""Vehicle-steps per second of the authors' environment with five vehicles and their CR-Net, one thread."""
LOCAL = {"sees_nearest": 4, "sees_within_mm": 400.0}


@pytest.fixture(autouse=True)
def one_thread():
    threads = torch.get_num_threads()
    torch.set_num_threads(1)
    yield
    torch.set_num_threads(threads)


def collective(robot, vehicles=5, **changes):
    """The task, in an arena that gives each vehicle as much room as five have in theirs."""
    content = yaml.safe_load((config_folder() / "task" / "collective.yaml").read_text())
    side = float(np.sqrt(vehicles / 5))
    arena = Arena(x=(0.0, 1030.0 * side), y=(0.0, 1030.0 * side))
    wide = {"reach_mm": content["reach_mm"] * side, "steps": 10_000 if vehicles > 5 else content["steps"]}
    return task_config({**content, "vehicles": vehicles, **wide, **changes}, "collective.yaml").build(robot, arena)


def simulation_of(robot, name):
    dynamics = NetworkDynamics(robot, config_class("mlp" if name == "table" else name)()).eval()
    return tabulated(Simulation(dynamics), LOOSE, wanted=name == "table")


def world_of(task, simulation, worlds, sampled=None, compiled=True):
    """Worlds that do not all end at once."""
    motion = fastest_motion(simulation, worlds, task.vehicles, sampled)
    world = World(task, motion, worlds, seed=0, compiled=compiled)
    world.step_count[:] = np.arange(worlds) * min(task.steps, 150) // worlds
    return world


def vehicle_steps(world, until):
    """How many vehicle-steps a world takes until a moment, observation, reward and new starts included."""
    random = np.random.default_rng(0)
    commands = random.uniform(world.robot.command_low, world.robot.command_high, (20, *world.shape))
    steps = 0
    while time.perf_counter() < until:
        step = world.step(commands[steps % 20])
        world.restart(step.ended, step.observation)
        steps += 1
    return steps * world.worlds * world.task.vehicles


def rates_of_worlds(robot, worlds, together, out):
    """Step a world of one's own, at the same time as others in other processes."""
    world = world_of(collective(robot), simulation_of(robot, "table"), worlds)
    vehicle_steps(world, time.perf_counter() + 0.2 * MEASURED_S)
    together.wait()
    start = time.perf_counter()
    out.put(vehicle_steps(world, start + MEASURED_S) / (time.perf_counter() - start))


def rate_side_by_side(robot, worlds, processes):
    """Vehicle-steps a second of as many processes, each with one thread and a world, as seeds are learned."""
    context = multiprocessing.get_context("spawn")
    together, out = context.Barrier(processes), context.Queue()
    running = [context.Process(target=rates_of_worlds, args=(robot, worlds, together, out)) for _ in range(processes)]
    for one in running:
        one.start()
    rate = sum(out.get(timeout=120) for _ in running)
    for one in running:
        one.join()
    return rate


def rate_of(world):
    """Vehicle-steps a second on one thread, once all is compiled."""
    vehicle_steps(world, time.perf_counter() + 0.2 * MEASURED_S)
    start = time.perf_counter()
    return vehicle_steps(world, start + MEASURED_S) / (time.perf_counter() - start)


@pytest.mark.benchmark_figures
def test_speed_of_the_group_by_model_and_number_of_worlds(robots):
    task, sizes = collective(robots["mgr"]), (1, 13, 100, 1000)
    rates = {}
    rows = ("table", *model_names())
    for name in rows:
        simulation = simulation_of(task.robot, name)
        for worlds in sizes:
            rates[name, worlds] = rate_of(world_of(task, simulation, worlds))
    print(f"\ncollective, 5 vehicles: times the authors' {PUBLISHED:,} vehicle-steps/s, by number of worlds")
    for name in rows:
        figures = "   ".join(f"{worlds}: {rates[name, worlds] / PUBLISHED:6.1f}" for worlds in sizes)
        print(f"{name:>14}   {figures}   ({rates[name, 1000]:,.0f}/s with 1000)")
    assert all(rate > 0 for rate in rates.values())


@pytest.mark.benchmark_figures
@pytest.mark.parametrize("worlds", [1024, 4096])
def test_speed_of_compiled_worlds(robots, worlds):
    robot = robots["mgr"]
    simulation = simulation_of(robot, "table")
    plain = rate_of(world_of(collective(robot), simulation, worlds, compiled=False))
    one = max(rate_of(world_of(collective(robot), simulation, worlds)) for _ in range(5))
    with ThreadPoolExecutor(2) as pool:
        pair = [world_of(collective(robot), simulation, worlds) for _ in range(2)]
        start = time.perf_counter()
        taken = pool.map(partial(vehicle_steps, until=start + MEASURED_S), pair)
        two = sum(taken) / (time.perf_counter() - start)
    print(f"\ncollective, 5 vehicles, {worlds} worlds, table, observation, reward and new starts, vehicle-steps/s:")
    print(
        f"  formulas {plain / 1e6:.2f} M; compiled {one / 1e6:.2f} M, best of five, {one / plain:.0f} times; ", end=""
    )
    print(f"two such, a thread each {two / 1e6:.2f} M, {two / one:.2f} times")
    alone, both = (max(rate_side_by_side(robot, worlds, processes) for _ in range(3)) for processes in (1, 2))
    print(f"  in processes of their own, best of three: one {alone / 1e6:.2f} M, two {both / 1e6:.2f} M, ", end="")
    print(f"{both / alone:.2f} times")
    assert one > 0


@pytest.mark.benchmark_figures
def test_cost_of_a_vehicle_step_by_the_size_of_the_group(robots):
    robot = robots["mgr"]
    simulation = simulation_of(robot, "table")
    cost = {}
    for vehicles in (5, 20, 50, 200):
        task = collective(robot, vehicles, **LOCAL)
        cost[vehicles] = 1e9 / rate_of(world_of(task, simulation, 8000 // vehicles))
    print("\na vehicle-step in groups that see their four nearest, 8,000 vehicles in all:")
    print("  " + "   ".join(f"K = {k}: {ns:.0f} ns, {ns / cost[5]:.1f} times" for k, ns in cost.items()))
    assert all(value > 0 for value in cost.values())
