"""What a picture of a world shows: one roll-out at one moment."""

from dataclasses import dataclass
from enum import Enum
from typing import NamedTuple

import numpy as np

from swarmtwin.geometry import compose, displacement_between
from swarmtwin.robot import Arena, Robot
from swarmtwin.world.rollout import NEVER, Rollout
from swarmtwin.world.task import TaskConfig


class Status(Enum):
    """How a roll-out stands; what is worse comes first where several hold."""

    COLLIDED = "collided"
    LEFT_ARENA = "left the arena"
    REACHED = "reached"
    ON_THE_WAY = "on the way"

    @classmethod
    def of(cls, collided: bool, left_arena: bool, reached: bool) -> "Status":
        """Return the status of a roll-out in which these things have happened so far."""
        if collided:
            return cls.COLLIDED
        if left_arena:
            return cls.LEFT_ARENA
        return cls.REACHED if reached else cls.ON_THE_WAY


@dataclass(frozen=True)
class Frame:
    """One world of K vehicles at one moment.

    Attributes:
        title: what moves the vehicles, for the picture's heading.
        robot: whose vehicles they are.
        arena: where they drive.
        task: what they are asked to do.
        path: (n, K, 3) poses from the start until now, a period apart but for the last.
        targets: (G, 2) x_mm, y_mm; (G, K, 2) where each vehicle has its own; NaN where there are none.
        leg: index of the target that is sought.
        obstacles: (O, 3) x_mm, y_mm, radius_mm.
        time_s: since the start.
        colliding: (K,) whether a vehicle collides at this moment.
        status: how the roll-out stands.
    """

    title: str
    robot: Robot
    arena: Arena
    task: TaskConfig
    path: np.ndarray
    targets: np.ndarray
    leg: int
    obstacles: np.ndarray
    time_s: float
    colliding: np.ndarray
    status: Status

    @property
    def farthest_mm(self) -> float:
        """How far the farthest vehicle is from the target that it seeks; NaN where there is none."""
        away = self.path[-1, :, :2] - self.targets[self.leg]
        return float(np.hypot(away[:, 0], away[:, 1]).max())

    @property
    def marks(self) -> list["Mark"]:
        """What is to be drawn of the targets."""
        marks = []
        for leg, target in enumerate(self.targets):
            for vehicle, place in enumerate(np.atleast_2d(target)):
                if np.isfinite(place).all():
                    marks.append(Mark(place, leg, vehicle if target.ndim == 2 else None))
        return marks


class Mark(NamedTuple):
    """A target in a picture.

    Attributes:
        place: (2,) x_mm, y_mm.
        leg: when it is sought.
        vehicle: whose it is; None: everybody's.
    """

    place: np.ndarray
    leg: int
    vehicle: int | None


def frame_of(rollout: Rollout, world: int, periods: float, title: str) -> Frame:
    """Return one world of a roll-out after some periods; between two of them the vehicles are in between."""
    periods = min(max(periods, 0.0), float(rollout.periods[world]))
    passed = int(periods)
    path = rollout.pose[: passed + 1, world]
    if (share := periods - passed) > 0:
        now, then = rollout.pose[passed, world], rollout.pose[passed + 1, world]
        path = np.concatenate([path, compose(now, share * displacement_between(now, then))[None]])
    steps = (rollout.collided_step[world], rollout.left_step[world], rollout.reached_step[world])
    collided, left_arena, reached = (step != NEVER and step <= passed for step in steps)
    vehicles = rollout.pose.shape[2]
    return Frame(
        title=title,
        robot=rollout.robot,
        arena=rollout.arena,
        task=rollout.task,
        path=path,
        targets=rollout.scenario.targets[world],
        leg=int(rollout.leg[passed, world]),
        obstacles=rollout.scenario.obstacles[world],
        time_s=periods * rollout.robot.period_s,
        colliding=rollout.collided[passed - 1, world] if passed else np.zeros(vehicles, dtype=bool),
        status=Status.of(collided, left_arena, reached),
    )
