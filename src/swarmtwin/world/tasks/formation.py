"""A group forms a line, a circle or a wedge about a place, and holds it."""

from typing import Literal

import numpy as np
from scipy.optimize import linear_sum_assignment

from swarmtwin.robot import Arena, Positive, Robot
from swarmtwin.world.group import Group, GroupConfig
from swarmtwin.world.scenario import Scenario
from swarmtwin.world.task import NotNegative

Shape = Literal["line", "circle", "wedge"]


class Formation(Group):
    """K vehicles, each with a place of its own in the formation as its target.

    Places are given at the start, to the vehicle of which the squared distances add up to least: straight ways to such
    places do not meet (Turpin, Michael and Kumar 2014, CAPT). A vehicle sees its own place alone, so that the policy
    need not know which vehicle it drives, nor which shape is asked for.
    """

    config: "Config"

    def __init__(self, robot: Robot, config: "Config", arena: Arena | None = None) -> None:
        super().__init__(robot, config, arena)
        self.offsets_mm = formation_offsets_mm(config.shape, config.vehicles, config.spacing_mm, config.facing_deg)
        self._check_shape()
        low_mm, high_mm = self.start_room_mm
        self.check_room(self._around_places((low_mm + high_mm)[None] / 2)[0])

    def draw(self, rng: np.random.Generator, worlds: int) -> Scenario:
        """Draw where the formation is to be, within the arena's margin, and starts apart and out of reach of it."""
        centre = rng.uniform(*self._centre_room_mm, (worlds, 1, 2))
        return self.beginning(self.draw_starts(rng, self._around_places(centre[:, 0])), centre)

    def beginning(self, start: np.ndarray, targets: np.ndarray, obstacles: np.ndarray | None = None) -> Scenario:
        """Give each vehicle its place.

        Args:
            start: (W, K, 3) where the vehicles stand.
            targets: (W, 1, 2) about which the formation is to be, or (W, 1, K, 2) the places of one.
            obstacles: none.
        """
        places = targets[:, :, None] + self.offsets_mm if targets.ndim == 3 else targets
        assigned = _assigned(start[..., :2], places[:, 0])
        return Scenario.beginning(start, assigned[:, None], obstacles)

    def reward_among(self, pose: np.ndarray, near_others: np.ndarray, target_mm: np.ndarray) -> np.ndarray:
        """Reward being in place, penalise the distance from it and near neighbours.

        r = reach_reward within `reach_mm` of the own place − d / d_max − near_penalty · (neighbours nearer than
        `neighbour_near_mm`).
        """
        return (
            self.config.reach_reward * (target_mm <= self.config.reach_mm)
            - target_mm / self.config.d_max_mm
            - self.config.near_penalty * near_others
        )

    @property
    def _centre_room_mm(self) -> tuple[np.ndarray, np.ndarray]:
        """The corners (2,) of the rectangle of all centres from which no place is nearer than the margin to a wall."""
        low_mm, high_mm = self.start_room_mm
        return low_mm - self.offsets_mm.min(axis=0), high_mm - self.offsets_mm.max(axis=0)

    def _around_places(self, centre: np.ndarray) -> np.ndarray:
        """Return circles of reach (W, K, 3) about the places of formations with centres (W, 2)."""
        places = centre[:, None] + self.offsets_mm
        return np.concatenate([places, np.full((*places.shape[:2], 1), self.config.reach_mm)], axis=-1)

    def _check_shape(self) -> None:
        width_mm, height_mm = np.ptp(self.offsets_mm, axis=0)
        low_mm, high_mm = self._centre_room_mm
        if not (low_mm <= high_mm + 1e-9).all():
            raise self.refusal(
                f"a {self.config.shape} of {self.vehicles} vehicles {self.config.spacing_mm:g} mm apart is "
                f"{width_mm:.0f} mm × {height_mm:.0f} mm and does not fit into the arena of {self.robot.name!r}",
                "lower vehicles, spacing_mm or margin_mm, or choose another shape",
            )
        if self.config.spacing_mm < self.config.collision_mm:
            raise self.refusal(
                f"spacing_mm {self.config.spacing_mm:g} is less than collision_mm {self.config.collision_mm:g}: "
                "vehicles in place would collide",
                "raise spacing_mm",
            )


def formation_offsets_mm(shape: Shape, vehicles: int, spacing_mm: float, facing_deg: float) -> np.ndarray:
    """Return the places of a formation about its centre, (K, 2) in the arena's frame.

    Args:
        shape: vehicles abreast, in a circle, or in a V whose point is ahead.
        vehicles: how many places, K.
        spacing_mm: between two places that are next to each other.
        facing_deg: where the formation faces, counter-clockwise from the x axis.
    """
    number = np.arange(vehicles)
    if shape == "line":
        ahead, left = np.zeros(vehicles), number * spacing_mm
    elif shape == "circle":
        angle_rad = 2 * np.pi * number / vehicles
        radius_mm = spacing_mm / (2 * np.sin(np.pi / vehicles)) if vehicles > 1 else 0.0
        ahead, left = radius_mm * np.cos(angle_rad), radius_mm * np.sin(angle_rad)
    else:
        rank, side = (number + 1) // 2, np.where(number % 2, 1.0, -1.0)
        ahead, left = -rank * spacing_mm / np.sqrt(2), side * rank * spacing_mm / np.sqrt(2)
    ahead, left = ahead - (ahead.max() + ahead.min()) / 2, left - (left.max() + left.min()) / 2
    facing_rad = np.radians(facing_deg)
    x_mm = np.cos(facing_rad) * ahead - np.sin(facing_rad) * left
    y_mm = np.sin(facing_rad) * ahead + np.cos(facing_rad) * left
    return np.stack([x_mm, y_mm], axis=-1)


def _assigned(position: np.ndarray, places: np.ndarray) -> np.ndarray:
    """Return places (W, K, 2) in the order of the vehicles at (W, K, 2) that they go to: least sum of squares."""
    squared = ((position[:, :, None] - places[:, None]) ** 2).sum(axis=-1)
    order = np.array([linear_sum_assignment(each)[1] for each in squared], dtype=int).reshape(places.shape[:2])
    return np.take_along_axis(places, order[..., None], axis=1)


class Config(GroupConfig):
    """`conf/task/formation.yaml`.

    Attributes:
        shape: `line`: abreast; `circle`; `wedge`: a V whose point is ahead.
        spacing_mm: between two places that are next to each other.
        facing_deg: where the formation faces, counter-clockwise from the x axis.
        d_max_mm: a distance of this much from its place costs a vehicle 1 a step.
        reach_reward: for being in place, a step.
        near_penalty: for each neighbour nearer than `neighbour_near_mm`, a step.
    """

    kind: Literal["formation"]
    shape: Shape
    spacing_mm: Positive
    facing_deg: float
    d_max_mm: Positive
    reach_reward: NotNegative
    near_penalty: NotNegative

    def build(self, robot: Robot, arena: Arena | None = None) -> Formation:
        """Return the task for a robot in an arena; None: the robot's usual one."""
        return Formation(robot, self, arena)
