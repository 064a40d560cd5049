"""Section 4.4: one vehicle reaches a target; a round obstacle lies between."""

from typing import Literal

import numpy as np

from swarmtwin.robot import Arena, Bounds, Positive, Robot
from swarmtwin.world import observations
from swarmtwin.world.scenario import Scenario, draw_apart
from swarmtwin.world.task import NotNegative, Task, TaskConfig


class Obstacle(Task):
    """A vehicle that sees target and obstacle; the roll-out ends when it reaches the one or touches the other."""

    ends_early = True

    def __init__(self, robot: Robot, config: "Config", arena: Arena | None = None) -> None:
        super().__init__(robot, config, arena)
        self.config: Config = config
        self.surrounding_names = observations.target_names() + observations.obstacle_names(1)
        self._check_distance()

    @property
    def half_vehicle_mm(self) -> float:
        """Half the vehicle's larger side: nearer to an edge it touches."""
        return max(self.robot.vehicle_size_mm) / 2

    def draw(self, rng: np.random.Generator, worlds: int) -> Scenario:
        """Draw a start, a target far enough away, and an obstacle across the straight line between them."""
        position = rng.uniform(*self.start_room_mm, (worlds, 2))
        around_start = np.full((worlds, 1, 3), self.config.distance_mm)
        around_start[:, 0, :2] = position
        target = draw_apart(rng, 1, self.start_room_mm, 0.0, around_start)[:, 0]
        line = target - position
        left = np.stack([-line[:, 1], line[:, 0]], axis=-1) / np.hypot(line[:, 0], line[:, 1])[:, None]
        radius_mm = rng.uniform(*self.config.radius_mm, (worlds, 1))
        along = rng.uniform(*self.config.along, (worlds, 1))
        aside = rng.uniform(*self.config.aside, (worlds, 1))
        centre = position + along * line + aside * radius_mm * left
        heading_rad = rng.uniform(-np.pi, np.pi, (worlds, 1))
        start = np.concatenate([position, heading_rad], axis=-1)
        obstacle = np.concatenate([centre, radius_mm], axis=-1)
        return Scenario.beginning(start[:, None], target[:, None], obstacle[:, None])

    def observe(self, scenario: Scenario, pose: np.ndarray) -> np.ndarray:
        """Show the target and the obstacle."""
        scaling = self.config.observation
        parts = [
            observations.observe_target(scenario, pose, scaling),
            observations.observe_obstacles(scenario, pose, self.half_vehicle_mm, scaling),
        ]
        return np.concatenate(parts, axis=-1, dtype=np.float32, casting="same_kind")

    def reward(self, scenario: Scenario, pose: np.ndarray) -> np.ndarray:
        """Reward reaching, penalise distance, nearness to the obstacle and collision.

        The paper gives no formula, only that reaching is rewarded, distance and collision are penalised, and averages
        of about −0.25 a step (table 5): so the distance costs d / d_max. A collision ends the roll-out and so saves all
        further distance: its penalty must be larger than that.
        """
        distance_mm = self.target_distance_mm(scenario, pose)
        near = (observations.edge_distance_mm(scenario, pose) - self.half_vehicle_mm < self.config.near_mm).any(axis=-1)
        return (
            self.config.reach_reward * (distance_mm <= self.config.reach_mm)
            - distance_mm / self.config.d_max_mm
            - self.config.near_penalty * near
            - self.config.collision_penalty * self.collided(scenario, pose)
        )

    def collided(self, scenario: Scenario, pose: np.ndarray) -> np.ndarray:
        """Return whether the vehicle, taken as round, touches the obstacle."""
        return np.any(observations.edge_distance_mm(scenario, pose) < self.half_vehicle_mm, axis=-1)

    def _check_distance(self) -> None:
        low, high = self.start_room_mm
        most_mm = float(np.hypot(*(high - low))) / 2
        needed_mm = (self.config.radius_mm[1] + self.half_vehicle_mm + self.config.clearance_mm) / self.config.along[0]
        if needed_mm > most_mm:
            raise self.refusal(
                f"an obstacle of {self.config.radius_mm[1]:g} mm does not fit between start and target in the arena of "
                f"{self.robot.name!r}",
                "lower radius_mm, clearance_mm or margin_mm",
            )
        if not needed_mm <= self.config.distance_mm <= most_mm:
            raise self.refusal(
                f"distance_mm {self.config.distance_mm:g} between start and target leaves no room for the obstacle, or "
                f"is more than the arena of {self.robot.name!r} always has",
                f"choose it from {needed_mm:.0f} to {most_mm:.0f}",
            )


class Config(TaskConfig):
    """`conf/task/obstacle.yaml`.

    Attributes:
        vehicles: one.
        distance_mm: least distance from start to target.
        radius_mm: the obstacle's radius is drawn from this range.
        along: its centre lies within this range of shares of the straight line from start to target.
        aside: and to the side of that line by a share of its radius in this range, left positive.
        clearance_mm: at least this much is free between the obstacle and the vehicle at the start.
        d_max_mm: a distance from the target of this much costs 1 a step.
        reach_reward: for reaching the target.
        near_mm: a gap between vehicle and obstacle smaller than this costs `near_penalty`.
        near_penalty: a step.
        collision_penalty: for touching the obstacle.
    """

    kind: Literal["obstacle"]
    vehicles: Literal[1]
    distance_mm: Positive
    radius_mm: Bounds
    along: Bounds = (0.35, 0.65)
    aside: Bounds = (-0.8, 0.8)
    clearance_mm: NotNegative
    d_max_mm: Positive
    reach_reward: NotNegative
    near_mm: NotNegative
    near_penalty: NotNegative
    collision_penalty: NotNegative

    def build(self, robot: Robot, arena: Arena | None = None) -> Obstacle:
        """Return the task for a robot in an arena; None: the robot's usual one."""
        return Obstacle(robot, self, arena)
