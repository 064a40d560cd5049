"""Section 4.5: a group moves to a target, or to one after the other; its vehicles keep their distance."""

from typing import Annotated, Literal

import numpy as np
from pydantic import Field

from swarmtwin.robot import Arena, Positive, Robot
from swarmtwin.world.group import Group, GroupConfig
from swarmtwin.world.scenario import Scenario, draw_apart, inner_room
from swarmtwin.world.task import Count, NotNegative, Share


class Collective(Group):
    """K vehicles that share one policy and a target."""

    config: "Config"

    def __init__(self, robot: Robot, config: "Config", arena: Arena | None = None) -> None:
        super().__init__(robot, config, arena)
        self._check_targets()
        low, high = self.start_room_mm
        self.check_room(np.array([[*(low + high) / 2, config.reach_mm]]))

    @property
    def legs(self) -> int:
        """How many targets there are, one after the other."""
        return self.config.targets

    def draw(self, rng: np.random.Generator, worlds: int) -> Scenario:
        """Draw targets in the arena's inner part, starts apart from each other and out of reach of the first target."""
        targets = self._draw_targets(rng, worlds)
        around_target = np.full((worlds, 1, 3), self.config.reach_mm)
        around_target[:, 0, :2] = targets[:, 0]
        return Scenario.beginning(self.draw_starts(rng, around_target), targets)

    def reward_among(self, pose: np.ndarray, near_others: np.ndarray, target_mm: np.ndarray) -> np.ndarray:
        """Return equation (3): what the target gives, or the distance from it, and what each near neighbour costs.

        r = r_target − 5 · (neighbours nearer than `neighbour_near_mm`), where r_target is −5 within `target_near_mm` of
        the target and −20 · d / d_max at a distance d further away. Where walls count, which they do not in the paper,
        being nearer to one than `wall_near_mm` costs as much as a neighbour.
        """
        near_target = target_mm < self.config.target_near_mm
        target_reward = np.where(near_target, -5.0, -20.0 * target_mm / self.config.d_max_mm)
        return target_reward - 5.0 * (near_others + self._near_wall(pose))

    def _near_wall(self, pose: np.ndarray) -> np.ndarray:
        """Return whether each vehicle is nearer to the arena's border than `wall_near_mm`, or beyond it, (W, K)."""
        if not self.config.wall_near_mm:
            return np.zeros(pose.shape[:-1], dtype=bool)
        position = pose[..., :2]
        inside = np.minimum(position - self.arena.low_mm, self.arena.high_mm - position)
        return np.any(inside < self.config.wall_near_mm, axis=-1)

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


class Config(GroupConfig):
    """`conf/task/collective.yaml`, `conf/task/pair.yaml`.

    Attributes:
        vehicles: K, at least 2.
        d_max_mm: of equation (3).
        target_near_mm: of equation (3): nearer to the target costs as much as being far from it.
        wall_near_mm: nearer to the arena's border costs as much as a neighbour; 0: walls do not count.
        targets: how many are to be reached, one after the other.
        target_room: targets lie in the arena's inner part, this share of its sides.
        targets_apart_mm: least distance from one target to the next.
    """

    kind: Literal["collective"]
    vehicles: Annotated[int, Field(ge=2)]
    d_max_mm: Positive
    target_near_mm: NotNegative
    wall_near_mm: NotNegative = 0.0
    targets: Count
    target_room: Share
    targets_apart_mm: NotNegative

    def build(self, robot: Robot, arena: Arena | None = None) -> Collective:
        """Return the task for a robot in an arena; None: the robot's usual one."""
        return Collective(robot, self, arena)
