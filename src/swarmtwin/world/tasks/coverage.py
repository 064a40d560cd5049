"""A group spreads so that the arena's ground is covered."""

from typing import Literal

import numpy as np

from swarmtwin.robot import Arena, Positive, Robot
from swarmtwin.world.group import Group, GroupConfig
from swarmtwin.world.scenario import Scenario
from swarmtwin.world.task import Count, NotNegative, Share


class Coverage(Group):
    """K vehicles, each of which covers the ground within a radius: nobody has a place of its own.

    What is shown where other tasks show a target is the middle of the vehicle's own ground: all that it covers and no
    other vehicle is nearer to. Who goes there covers more, and where nobody can do better all are there (Cortés,
    Martínez, Karatas and Bullo 2004). It depends on neighbours within twice the radius alone, so it is local.

    Attributes:
        ground: (P, 2) x_mm, y_mm of the points that stand for the ground.
    """

    config: "Config"

    def __init__(self, robot: Robot, config: "Config", arena: Arena | None = None) -> None:
        super().__init__(robot, config, arena)
        self.ground = _grid_mm(self.arena, config.grid)
        self._check_share()
        self.check_room(np.empty((0, 3)))

    def draw(self, rng: np.random.Generator, worlds: int) -> Scenario:
        """Draw starts apart from each other that do not cover enough yet; there are no targets.

        Raises:
            UserError: nearly all starts do.
        """
        start = self.draw_starts(rng, np.empty((worlds, 0, 3)))
        done = np.flatnonzero(self.covered_share(start) >= self.config.covered)
        for _ in range(200):
            if not len(done):
                return Scenario.beginning(start, np.full((worlds, 1, 2), np.nan))
            start[done] = self.draw_starts(rng, np.empty((len(done), 0, 3)))
            done = done[self.covered_share(start[done]) >= self.config.covered]
        raise self.refusal("wherever the vehicles start, they cover enough already", "lower reach_mm or vehicles")

    @property
    def near_enough_mm(self) -> float:
        """Nothing: in the middle of its own ground itself a vehicle covers most."""
        return 0.0

    def shown_place(self, scenario: Scenario, pose: np.ndarray) -> np.ndarray:
        """Return the middle of each vehicle's own ground."""
        return self.middle_of_own_ground(pose)

    def reward_among(self, pose: np.ndarray, near_others: np.ndarray, target_mm: np.ndarray) -> np.ndarray:
        """Penalise how far the ground is from the vehicle nearest to it, the same for all, and near neighbours.

        r = −(mean over the ground of the distance to the nearest vehicle) / d_max − near_penalty · (neighbours nearer
        than `neighbour_near_mm`).
        """
        _, distance_mm = self._nearest_vehicle(pose)
        shared = -distance_mm.mean(axis=1, keepdims=True) / self.config.d_max_mm
        return shared - self.config.near_penalty * near_others

    def is_at_target(self, pose: np.ndarray, target_mm: np.ndarray) -> np.ndarray:
        """All vehicles are where they should be as soon as enough is covered."""
        enough = self.covered_share(pose) >= self.config.covered
        return np.repeat(enough[:, None], pose.shape[1], axis=1)

    def covered_share(self, pose: np.ndarray) -> np.ndarray:
        """Return the share of the ground that is within `reach_mm` of a vehicle, (W,)."""
        _, distance_mm = self._nearest_vehicle(pose)
        return np.asarray((distance_mm <= self.config.reach_mm).mean(axis=1))

    def middle_of_own_ground(self, pose: np.ndarray) -> np.ndarray:
        """Return the mean of the ground that each vehicle covers and is nearest to, (W, K, 2); without any, itself."""
        worlds, vehicles = pose.shape[:2]
        nearest, distance_mm = self._nearest_vehicle(pose)
        owner = (nearest + vehicles * np.arange(worlds)[:, None]).ravel()
        covered = (distance_mm <= self.config.reach_mm).ravel()
        points = np.bincount(owner, covered, worlds * vehicles)
        sums = [np.bincount(owner, covered * np.tile(axis, worlds), worlds * vehicles) for axis in self.ground.T]
        middle = np.stack(sums, axis=-1) / np.maximum(points, 1)[:, None]
        return np.where(points[:, None] > 0, middle, pose[..., :2].reshape(-1, 2)).reshape(worlds, vehicles, 2)

    def _nearest_vehicle(self, pose: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return which vehicle is nearest to each point of the ground, and how far it is, (W, P)."""
        away_x, away_y = (pose[:, None, :, axis] - self.ground[:, None, axis] for axis in range(2))
        squared = away_x**2 + away_y**2
        nearest = squared.argmin(axis=2)
        return nearest, np.sqrt(np.take_along_axis(squared, nearest[..., None], axis=2)[..., 0])

    def _check_share(self) -> None:
        size_mm = self.arena.high_mm - self.arena.low_mm
        most = self.vehicles * np.pi * self.config.reach_mm**2 / float(np.prod(size_mm))
        if most < self.config.covered:
            raise self.refusal(
                f"{self.vehicles} vehicles that each cover {self.config.reach_mm:g} mm about them cover at most "
                f"{most:.0%} of the arena of {self.robot.name!r}, and {self.config.covered:.0%} are asked for",
                "raise vehicles or reach_mm, or lower covered",
            )


def _grid_mm(arena: Arena, points: int) -> np.ndarray:
    """Return the middles (P, 2) of equal squares, `points` along the arena's shorter side, as fine along the other."""
    size_mm = arena.high_mm - arena.low_mm
    counts = np.round(points * size_mm / size_mm.min()).astype(int)
    axes = [
        low_mm + (np.arange(count) + 0.5) * side_mm / count
        for low_mm, side_mm, count in zip(arena.low_mm, size_mm, counts, strict=True)
    ]
    return np.stack(np.meshgrid(*axes), axis=-1).reshape(-1, 2)


class Config(GroupConfig):
    """`conf/task/coverage.yaml`.

    Attributes:
        vehicles: K.
        reach_mm: a vehicle covers the ground within this distance of it.
        hold_s: done once enough has been covered for this long, in a row.
        covered: the share of the ground that is to be covered.
        grid: the ground is judged at this many points along the arena's shorter side, and as densely along the other.
        d_max_mm: a mean distance of this much from the ground to the vehicle nearest to it costs 1 a step.
        near_penalty: for each neighbour nearer than `neighbour_near_mm`, a step.
    """

    kind: Literal["coverage"]
    covered: Share
    grid: Count
    d_max_mm: Positive
    near_penalty: NotNegative

    def build(self, robot: Robot, arena: Arena | None = None) -> Coverage:
        """Return the task for a robot in an arena; None: the robot's usual one."""
        return Coverage(robot, self, arena)
