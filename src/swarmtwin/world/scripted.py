"""A policy that nobody had to learn: looks ahead in the robot's nominal kinematics, and takes the best command.

The dynamic window approach (Fox, Burgard and Thrun 1997): every candidate command is imagined to be held for a few
periods, and judged by how far from the place sought it leads and how near to others, to obstacles and to walls. It
knows what a learned policy knows, the observation, and moves by the equations that the robot's file names, with nothing
fitted: a baseline for learned policies, and a check that a task can be done.
"""

import math
from itertools import product

import numpy as np
import torch

from swarmtwin.geometry import integrate_twist
from swarmtwin.robot import Positive, Robot, StrictModel
from swarmtwin.world.task import Count, NotNegative, Task


class LookAhead(StrictModel):
    """How a scripted policy decides.

    Attributes:
        periods: how long a command is imagined to be held.
        candidates: about how many commands are compared.
        arrived: within this share of the reach of the place sought, there is little reason to go nearer.
        inward: what a mm from the place sought costs there, against 1 further away: little enough to keep off others,
            and enough to let those in who come later.
        margin_steps: how much room is kept to others beyond touching them, in steps at full speed; who moves keeps one
            step of its own more.
        crowding: what coming nearer than that costs, per mm, against 1 per mm from the place sought.
        effort: what a command at its limits costs, in mm: of two equal ones the smaller is taken.
    """

    periods: Count = 6
    candidates: Count = 100
    arrived: Positive = 0.8
    inward: NotNegative = 0.1
    margin_steps: Positive = 0.4
    crowding: Positive = 10.0
    effort: Positive = 2.0

    @classmethod
    def of(cls, robot: Robot) -> "LookAhead":
        """Return what suits a robot: one that swims glides on, so it keeps off further and rests once there."""
        if robot.actuation.kind == "thrust":
            return cls(arrived=0.9, inward=0.0, margin_steps=1.0)
        return cls()


class ScriptedPolicy:
    """Decides for each vehicle of a task by what it observes.

    Attributes:
        task: what is asked of the vehicles.
        settings: how it decides.
        commands: (N, m) the candidates, in the robot's units.
        paths: (N, H, 2) forward_mm, left_mm where each leads, at the ends of H periods.
    """

    def __init__(self, task: Task, settings: LookAhead | None = None) -> None:
        """Imagine all candidates once.

        Raises:
            UserError: the task shows no place to go to, or the robot's file names no kinematics.
        """
        self.task = task
        self.settings = settings or LookAhead.of(task.robot)
        names = task.observation_names
        if "target_forward" not in names:
            raise task.refusal("its vehicles see no place to go to: there is no scripted policy", "learn one")
        robot = task.robot
        self.commands = candidate_commands(robot, self.settings.candidates)
        self.paths = nominal_paths(robot, self.commands, self.settings.periods)
        share = (self.commands - robot.command_at_rest) / (robot.command_high - robot.command_low)
        self._effort_mm = self.settings.effort * np.abs(share).max(axis=1)
        self._column = {name: column for column, name in enumerate(names)}
        self._body_mm = max(robot.vehicle_size_mm) / 2
        self._room_mm = self.settings.margin_steps * robot.largest_displacement.forward_mm
        touching_mm = float(getattr(task.config, "collision_mm", 2 * self._body_mm))
        self._farthest_mm = float(np.linalg.norm(self.paths, axis=-1).max())
        step_mm = np.hypot(self.paths[:, :1, 0], self.paths[:, :1, 1])
        self._apart_mm = (touching_mm + self._room_mm + step_mm)[None]  # (1, N, 1): who is fast keeps away further

    def act(self, observation: np.ndarray) -> np.ndarray:
        """Return commands (W, K, m) for the observations (W, K, o) of W · K vehicles."""
        seen = observation.reshape(-1, observation.shape[-1]).astype(float)
        cost = self._goal_cost(seen) + self._effort_mm
        cost += self.settings.crowding * (self._neighbour_cost(seen) + self._obstacle_cost(seen))
        cost += self.settings.crowding * self._wall_cost(seen)
        best = cost.argmin(axis=1)
        return np.asarray(self.commands[best].reshape(*observation.shape[:2], -1))

    def _goal_cost(self, seen: np.ndarray) -> np.ndarray:
        """Return how far from the place sought the candidates lead, on average over the periods, (n, N) mm."""
        scale_mm = self.task.config.observation.target_mm
        place = scale_mm * self._values(seen, "target_forward", "target_left")
        enough_mm = self.settings.arrived * self.task.near_enough_mm
        for centre, radius_mm in self._obstacles(seen):
            place = _around(place, centre, radius_mm + self._body_mm + self._room_mm)
        away_mm = _distance_mm(self.paths, place)
        cost = np.maximum(away_mm - enough_mm, 0.0) + self.settings.inward * np.minimum(away_mm, enough_mm)
        return np.asarray(cost.mean(axis=2))

    def _neighbour_cost(self, seen: np.ndarray) -> np.ndarray:
        """Return by how much the candidates lead too near to where others are now, (n, N) mm."""
        cost = np.zeros((len(seen), len(self.commands)))
        for rank in self._ranks("neighbour"):
            name = f"neighbour_{rank}"
            place = self.task.config.observation.neighbour_mm * self._values(seen, f"{name}_forward", f"{name}_left")
            somebody = seen[:, self._column[f"{name}_closeness"]] > 0
            cost[somebody] += self._too_near_mm(place[somebody], self._apart_mm)
        return cost

    def _obstacle_cost(self, seen: np.ndarray) -> np.ndarray:
        """Return by how much the candidates lead too near to the obstacles, (n, N) mm."""
        cost = np.zeros((len(seen), len(self.commands)))
        for centre, radius_mm in self._obstacles(seen):
            cost += self._too_near_mm(centre, (radius_mm + self._body_mm + self._room_mm)[:, None, None])
        return cost

    def _too_near_mm(self, place: np.ndarray, apart_mm: np.ndarray) -> np.ndarray:
        """Return by how much the paths come nearer than `apart_mm` to places (n, 2), on average over time, (n, N)."""
        cost = np.zeros((len(place), len(self.commands)))
        apart_mm = np.broadcast_to(apart_mm, (len(place), len(self.commands), 1))
        near = np.hypot(*place.T) < apart_mm.max(initial=0.0) + self._farthest_mm
        cost[near] = np.maximum(apart_mm[near] - _distance_mm(self.paths, place[near]), 0.0).mean(axis=2)
        return cost

    def _wall_cost(self, seen: np.ndarray) -> np.ndarray:
        """Return by how much the candidates lead too near to the walls, as far as these are seen, (n, N) mm."""
        cost = np.zeros((len(seen), len(self.commands)))
        walls = [name for name in self._column if name.startswith("wall_")]
        for index, name in enumerate(walls):
            angle_rad = 2 * np.pi * index / len(walls)
            along = self.paths @ np.array([np.cos(angle_rad), np.sin(angle_rad)])
            closeness = seen[:, self._column[name]]
            free_mm = -self.task.config.observation.wall_closeness_mm * np.log(np.maximum(closeness, 1e-12))
            cost += np.maximum(along - (free_mm - self._body_mm)[:, None, None], 0.0).mean(axis=2)
        return cost

    def _obstacles(self, seen: np.ndarray) -> list[tuple[np.ndarray, np.ndarray]]:
        """Return centre (n, 2) forward_mm, left_mm and radius_mm (n,) of each obstacle that is seen."""
        scale_mm = self.task.config.observation.neighbour_mm
        found = []
        for rank in self._ranks("obstacle"):
            name = f"obstacle_{rank}"
            centre = scale_mm * self._values(seen, f"{name}_forward", f"{name}_left")
            found.append((centre, scale_mm * seen[:, self._column[f"{name}_radius"]]))
        return found

    def _ranks(self, what: str) -> range:
        count = sum(name.startswith(f"{what}_") and name.endswith("_closeness") for name in self._column)
        return range(1, count + 1)

    def _values(self, seen: np.ndarray, *names: str) -> np.ndarray:
        return seen[:, [self._column[name] for name in names]]


def candidate_commands(robot: Robot, about: int) -> np.ndarray:
    """Return commands (N, m) evenly over the robot's limits, with the resting command first."""
    per_column = max(3, round(about ** (1 / len(robot.command))))
    per_column += 1 - per_column % 2  # an odd number has the middle among them
    levels = [np.linspace(column.low, column.high, per_column) for column in robot.command.values()]
    return np.concatenate([robot.command_at_rest[None], np.array(list(product(*levels)))])


def nominal_paths(robot: Robot, commands: np.ndarray, periods: int) -> np.ndarray:
    """Return where held commands (N, m) lead, (N, H, 2) forward_mm, left_mm, by the robot's nominal kinematics.

    Raises:
        UserError: the robot's file names no kinematics.
    """
    equations = robot.kinematic_equations()
    values = {name: torch.tensor(value) for name, value in equations.nominal_values(robot).items()}
    velocity = equations.velocities(torch.as_tensor(commands, dtype=torch.float32), values, robot)
    twist = torch.stack(velocity, dim=-1).double().numpy()
    ends = [integrate_twist(twist, robot.period_s * period) for period in range(1, periods + 1)]
    return np.stack(ends, axis=1)[..., :2]


def _distance_mm(paths: np.ndarray, place: np.ndarray) -> np.ndarray:
    """Return the distances (n, N, H) of paths (N, H, 2) from places (n, 2)."""
    across = place @ paths.reshape(-1, 2).T
    squared = (place**2).sum(axis=-1)[:, None] + (paths**2).sum(axis=-1).ravel() - 2.0 * across
    return np.asarray(np.sqrt(np.maximum(squared, 0.0)).reshape(len(place), *paths.shape[:2]))


def _around(place: np.ndarray, centre: np.ndarray, radius_mm: np.ndarray) -> np.ndarray:
    """Return places (n, 2), or where a circle is in the way, the point on its nearer side to go by, that of a tangent.

    Args:
        place: (n, 2) forward_mm, left_mm.
        centre: (n, 2) of the circles.
        radius_mm: (n,) of the circles.
    """
    far_mm, away_mm = np.hypot(*place.T), np.hypot(*centre.T)
    bearing_rad = np.arctan2(centre[:, 1], centre[:, 0])
    off_rad = np.arctan2(place[:, 1], place[:, 0]) - bearing_rad
    off_rad = (off_rad + math.pi) % (2 * math.pi) - math.pi
    widest_rad = np.arcsin(np.clip(radius_mm / np.maximum(away_mm, 1e-6), 0.0, 1.0))
    is_in_the_way = (np.abs(off_rad) < widest_rad) & (far_mm > away_mm)
    side = np.where(off_rad < 0, -1.0, 1.0)
    tangent_rad = bearing_rad + side * widest_rad
    tangent_mm = np.maximum(np.sqrt(np.maximum(away_mm**2 - radius_mm**2, 0.0)), radius_mm)
    beside = tangent_mm[:, None] * np.stack([np.cos(tangent_rad), np.sin(tangent_rad)], axis=-1)
    return np.where(is_in_the_way[:, None], beside, place)
