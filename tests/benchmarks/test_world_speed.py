"""How fast groups are simulated: figures to look at with `pytest -s -m benchmark_figures`."""

import time

import numpy as np
import pytest
import torch
import yaml

from swarmtwin.configuration import config_folder
from swarmtwin.dynamics.model_config import config_class, model_names
from swarmtwin.dynamics.predictor import NetworkDynamics
from swarmtwin.simulation.displacement_table import TableSettings, tabulated
from swarmtwin.simulation.simulation import Simulation
from swarmtwin.world.motion import SimulatedMotion
from swarmtwin.world.task import task_config
from swarmtwin.world.world import World

MEASURED_S = 1.0
LOOSE = TableSettings(position_mm=1e3, heading_deg=1e3)  # of an untrained network
PUBLISHED = 4_200
"""Vehicle-steps per second of the authors' environment with five vehicles and their CR-Net, one thread."""


class Nothing:
    """A motion that costs nothing, to see what the world itself costs."""

    def __init__(self, robot, worlds, vehicles):
        self.robot, self.pose = robot, np.zeros((worlds, vehicles, 3))

    def place(self, worlds, pose):
        self.pose[worlds] = pose
        return self.pose[worlds]

    def move(self, command):
        return self.pose


def vehicle_steps_per_s(world):
    """How many vehicle-steps a world takes a second, new starts included, on one thread."""
    random = np.random.default_rng(0)
    commands = random.uniform(world.robot.command_low, world.robot.command_high, (20, *world.shape))
    threads = torch.get_num_threads()
    torch.set_num_threads(1)
    try:
        steps, start = 0, time.perf_counter()
        while time.perf_counter() - start < MEASURED_S:
            step = world.step(commands[steps % 20])
            if step.ended.any():
                world.restart(step.ended)
            steps += 1
        return steps * world.worlds * world.task.vehicles / (time.perf_counter() - start)
    finally:
        torch.set_num_threads(threads)


@pytest.mark.benchmark_figures
def test_speed_of_the_group_by_model_and_number_of_worlds(robots):
    content = yaml.safe_load((config_folder() / "task" / "collective.yaml").read_text())
    task = task_config(content, "collective.yaml").build(robots["mgr"])
    sizes = (1, 13, 100, 1000)
    rates = {}
    rows = ("nothing moves", "table", *model_names())
    for name in rows:
        for worlds in sizes:
            if name == "nothing moves":
                motion = Nothing(task.robot, worlds, task.vehicles)
            else:
                dynamics = NetworkDynamics(task.robot, config_class("mlp" if name == "table" else name)()).eval()
                simulation = tabulated(Simulation(dynamics), LOOSE, wanted=name == "table")
                motion = SimulatedMotion(simulation, worlds, task.vehicles)
            rates[name, worlds] = vehicle_steps_per_s(World(task, motion, worlds, seed=0))
    print(f"\ncollective, 5 vehicles: times the authors' {PUBLISHED:,} vehicle-steps/s, by number of worlds")
    for name in rows:
        figures = "   ".join(f"{worlds}: {rates[name, worlds] / PUBLISHED:6.1f}" for worlds in sizes)
        share = rates[name, 1000] / rates["nothing moves", 1000]
        print(f"{name:>14}   {figures}   ({share:.2f} of the bare world's speed at {sizes[-1]})")
    assert all(rate > 0 for rate in rates.values())
