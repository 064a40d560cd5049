"""Vehicles visit a place, each on its own."""

from typing import Literal

import numpy as np

from swarmtwin.world.observations import observe_target, target_names
from swarmtwin.world.scenario import Scenario
from swarmtwin.world.task import Task, TaskConfig


class Visit(Task):
    """The nearer to the place, the better."""

    ends_early = False
    surrounding_names = target_names()

    def draw(self, rng, worlds):
        position = rng.uniform(*self.start_room_mm, (worlds, self.vehicles, 2))
        heading_rad = rng.uniform(-np.pi, np.pi, (worlds, self.vehicles, 1))
        target = rng.uniform(*self.start_room_mm, (worlds, 1, 2))
        return Scenario.beginning(np.concatenate([position, heading_rad], axis=-1), target)

    def observe(self, scenario, pose):
        return observe_target(scenario, pose, self.config.observation).astype(np.float32)

    def reward(self, scenario, pose):
        return -self.target_distance_mm(scenario, pose) / 1000

    def collided(self, scenario, pose):
        return np.zeros(pose.shape[:2], dtype=bool)


class Config(TaskConfig):
    """`conf/task/visit.yaml`."""

    kind: Literal["visit"]

    def build(self, robot, arena=None):
        return Visit(robot, self, arena)
