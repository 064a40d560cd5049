"""Worlds to test with: a motion whose every number is known by hand, and the shipped tasks."""

from pathlib import Path

import numpy as np
import torch
import yaml

from swarmtwin.dynamics.model_config import config_class
from swarmtwin.dynamics.predictor import NetworkDynamics
from swarmtwin.geometry import compose, wrap_angle
from swarmtwin.robot import Robot
from swarmtwin.simulation.simulation import Simulation
from swarmtwin.world.scenario import Scenario
from swarmtwin.world.task import task_config
from swarmtwin.world.world import World

CONF = Path(__file__).resolve().parents[2] / "conf"
TASKS = sorted(path.stem for path in (CONF / "task").glob("*.yaml"))
ROBOT_OF = {"pair": "mur"}


def robot_named(name):
    return Robot.load(CONF / "robot" / f"{name}.yaml")


def task_named(name, robot=None, arena=None, **changes):
    """A shipped task, with changes, for the robot that it is meant for."""
    content = yaml.safe_load((CONF / "task" / f"{name}.yaml").read_text())
    robot = robot or robot_named(ROBOT_OF.get(name, "mgr"))
    return task_config({**content, **changes}, f"{name}.yaml").build(robot, arena)


class ExactMotion:
    """Moves each vehicle forward by 10 mm and to the left by 3 mm at full command, and turns it by 0.1 rad."""

    def __init__(self, robot, worlds, vehicles):
        self.robot = robot
        self.pose = np.zeros((worlds, vehicles, 3))

    def place(self, worlds, pose):
        self.pose[worlds] = pose
        return self.pose[worlds]

    def move(self, command):
        share = command / self.robot.command_high
        displacement = np.stack([10 * share[..., 0], 3 * share[..., 0], 0.1 * share[..., 1]], axis=-1)
        self.pose = compose(self.pose, displacement)
        return self.pose.copy()


class Still(ExactMotion):
    """Vehicles that stay where they are, whatever they are told."""

    def move(self, command):
        return self.pose.copy()


class Scripted(ExactMotion):
    """Vehicles that go through given poses (T, W, K, 3), whatever they are told."""

    def __init__(self, robot, poses):
        super().__init__(robot, *poses.shape[1:3])
        self.poses = iter(poses)

    def move(self, command):
        return next(self.poses).copy()


def world_of(task, worlds=3, seed=0, motion=ExactMotion):
    return World(task, motion(task.robot, worlds, task.vehicles), worlds, seed)


def dynamics_of(robot, name, situation=None):
    """An untrained model of small displacements."""
    changes = {} if situation is None else {"situation": situation}
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(0)
        return NetworkDynamics(robot, config_class(name)(**changes)).eval()


def simulation_of(robot, name, situation=None):
    """The simulation whose vehicles move as an untrained model predicts."""
    return Simulation(dynamics_of(robot, name, situation))


def moved(scenario, pose, shift=(0.0, 0.0), turn_rad=0.0):
    """A scenario and poses, seen from an arena frame that is shifted and turned."""
    cos, sin = np.cos(turn_rad), np.sin(turn_rad)
    turned = np.array([[cos, sin], [-sin, cos]])

    def places(position):
        return position @ turned + shift

    def poses(pose):
        return np.concatenate([places(pose[..., :2]), wrap_angle(pose[..., 2:] + turn_rad)], axis=-1)

    obstacles = np.concatenate([places(scenario.obstacles[..., :2]), scenario.obstacles[..., 2:]], axis=-1)
    return Scenario(poses(scenario.start), places(scenario.targets), obstacles, scenario.leg), poses(pose)


def one_world(task, pose, target, obstacle=None):
    """A scenario of one world with vehicles at `pose` (K, 3) and a target (2,)."""
    targets = np.array([[target] * task.legs], dtype=float)
    obstacles = None if obstacle is None else np.array([[obstacle]], dtype=float)
    return Scenario.beginning(np.array([pose], dtype=float), targets, obstacles)
