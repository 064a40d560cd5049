"""Section 4.5: a group moves to a target, or to one after the other; its vehicles keep their distance."""

from typing import Annotated, Literal

import numpy as np
from pydantic import Field

from swarmtwin.robot import Arena, Positive, Robot
from swarmtwin.world import observations
from swarmtwin.world.scenario import Scenario, draw_apart, inner_room, room_for
from swarmtwin.world.task import Count, NotNegative, Share, Task, TaskConfig


class Collective(Task):
    """K vehicles that share one policy and know each other's poses."""

    ends_early = False

    def __init__(self, robot: Robot, config: "Config", arena: Arena | None = None) -> None:
        super().__init__(robot, config, arena)
        self.config: Config = config
        names = observations.target_names() + observations.neighbour_names(config.vehicles - 1)
        self.observation_names = names + (observations.wall_names() if config.sees_walls else ())
        self._check_distances()
        self._check_targets()
        self._check_room()

    @property
    def legs(self) -> int:
        """How many targets there are, one after the other."""
        return self.config.targets

    def draw(self, rng: np.random.Generator, worlds: int) -> Scenario:
        """Draw targets in the arena's inner part, starts apart from each other and out of reach of the first target."""
        targets = self._draw_targets(rng, worlds)
        around_target = np.full((worlds, 1, 3), self.config.reach_mm)
        around_target[:, 0, :2] = targets[:, 0]
        count, apart_mm = self.vehicles, self.config.separation_mm
        position = draw_apart(rng, count, self.start_room_mm, apart_mm, around_target)
        heading_rad = rng.uniform(-np.pi, np.pi, (worlds, count, 1))
        return Scenario.beginning(np.concatenate([position, heading_rad], axis=-1), targets)

    def observe(self, scenario: Scenario, pose: np.ndarray) -> np.ndarray:
        """Show the target, the others, nearest first, and the walls where they count."""
        scaling = self.config.observation
        parts = [
            observations.observe_target(scenario, pose, scaling),
            observations.observe_neighbours(pose, self.config.collision_mm, scaling),
        ]
        if self.config.sees_walls:
            parts.append(observations.observe_walls(pose, self.arena, scaling))
        return np.concatenate(parts, axis=-1, dtype=np.float32, casting="same_kind")

    def reward(self, scenario: Scenario, pose: np.ndarray) -> np.ndarray:
        """Return equation (3): what the target gives, or the distance from it, and what each near neighbour costs.

        r = r_target − 5 · (neighbours nearer than `neighbour_near_mm`), where r_target is −5 within `target_near_mm` of
        the target and −20 · d / d_max at a distance d further away.
        """
        target_mm = self.target_distance_mm(scenario, pose)
        near_target = target_mm < self.config.target_near_mm
        target_reward = np.where(near_target, -5.0, -20.0 * target_mm / self.config.d_max_mm)
        near_others = (observations.between_vehicles_mm(pose) < self.config.neighbour_near_mm).sum(axis=-1)
        return target_reward - 5.0 * near_others

    def collided(self, scenario: Scenario, pose: np.ndarray) -> np.ndarray:
        """Two vehicles collide when their centres are nearer than `collision_mm` (the authors' code: 100 mm)."""
        return np.any(observations.between_vehicles_mm(pose) < self.config.collision_mm, axis=-1)

    def _draw_targets(self, rng: np.random.Generator, worlds: int) -> np.ndarray:
        """Draw targets (W, G, 2), each at least `targets_apart_mm` from the one before."""
        room = self._target_room_mm
        targets = rng.uniform(*room, (worlds, self.config.targets, 2))
        for leg in range(1, self.config.targets):
            former = np.full((worlds, 1, 3), self.config.targets_apart_mm)
            former[:, 0, :2] = targets[:, leg - 1]
            targets[:, leg : leg + 1] = draw_apart(rng, 1, room, 0.0, former)
        return targets

    @property
    def _target_room_mm(self) -> tuple[np.ndarray, np.ndarray]:
        return inner_room(self.arena.low_mm, self.arena.high_mm, self.config.target_room)

    def _check_distances(self) -> None:
        width_mm = min(self.robot.vehicle_size_mm)
        if self.config.collision_mm < width_mm:
            raise self.refusal(
                f"collision_mm {self.config.collision_mm:g} is less than the width of {self.robot.name!r}, "
                f"{width_mm:g} mm: vehicles would pass through each other",
                "raise collision_mm, or choose another task for this robot",
            )
        if self.config.separation_mm < self.config.collision_mm:
            raise self.refusal(
                f"separation_mm {self.config.separation_mm:g} is less than collision_mm "
                f"{self.config.collision_mm:g}: vehicles would start in a collision",
                "raise separation_mm",
            )

    def _check_targets(self) -> None:
        low, high = self._target_room_mm
        farthest_mm = float(np.hypot(*(high - low))) / 2
        if self.config.targets > 1 and self.config.targets_apart_mm > farthest_mm:
            raise self.refusal(
                f"targets {self.config.targets_apart_mm:g} mm apart do not always fit into the inner part of the arena",
                f"lower targets_apart_mm to {farthest_mm:.0f} or less",
            )
        around = (self.config.reach_mm / (self.config.collision_mm / 2) + 1) ** 2
        most = int(np.pi / np.sqrt(12) * around)  # the densest packing of circles in the plane
        if self.vehicles > most:
            raise self.refusal(
                f"{self.vehicles} vehicles can never be within {self.config.reach_mm:g} mm of a target at once without "
                f"a collision: at most {most} can",
                "lower vehicles, or raise reach_mm",
            )

    def _check_room(self) -> None:
        low, high = self.start_room_mm
        target = np.array([[*(low + high) / 2, self.config.reach_mm]])
        fitting = room_for(self.vehicles, (low, high), self.config.separation_mm, target)
        if fitting < self.vehicles:
            raise self.refusal(
                f"{self.vehicles} vehicles do not fit into the arena of {self.robot.name!r} with "
                f"{self.config.separation_mm:g} mm between them: about {fitting} do",
                "lower vehicles, separation_mm or margin_mm",
            )


class Config(TaskConfig):
    """`conf/task/collective.yaml`, `conf/task/pair.yaml`.

    Attributes:
        vehicles: K, at least 2.
        d_max_mm: of equation (3).
        target_near_mm: of equation (3): nearer to the target costs as much as being far from it.
        neighbour_near_mm: of equation (3): nearer to another vehicle costs.
        collision_mm: two centres nearer than this are a collision.
        separation_mm: starts are at least this far apart.
        targets: how many are to be reached, one after the other.
        target_room: targets lie in the arena's inner part, this share of its sides.
        targets_apart_mm: least distance from one target to the next.
        sees_walls: whether vehicles see the arena's border.
    """

    kind: Literal["collective"]
    vehicles: Annotated[int, Field(ge=2)]
    d_max_mm: Positive
    target_near_mm: NotNegative
    neighbour_near_mm: NotNegative
    collision_mm: Positive
    separation_mm: Positive
    targets: Count
    target_room: Share
    targets_apart_mm: NotNegative
    sees_walls: bool

    def build(self, robot: Robot, arena: Arena | None = None) -> Collective:
        """Return the task for a robot in an arena; None: the robot's usual one."""
        return Collective(robot, self, arena)
