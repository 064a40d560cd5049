"""What the task of `world/tasks/collective.py` measures, compiled."""

import math
from typing import NamedTuple

import numpy as np

from swarmtwin.compiled import compiled
from swarmtwin.world.compiled import Measure, lanes
from swarmtwin.world.scenario import Scenario
from swarmtwin.world.task import Events, Measured
from swarmtwin.world.tasks.collective import Collective


class Numbers(NamedTuple):
    """The numbers of the task's configuration, float32; in mm."""

    arena: tuple[np.float32, np.float32, np.float32, np.float32]
    target: np.float32
    range: np.float32
    neighbour: np.float32
    closeness: np.float32
    wall_closeness: np.float32
    d_max: np.float32
    target_near: np.float32
    neighbour_near: np.float32
    collision: np.float32
    reach: np.float32
    outside: np.float32
    lost: np.float32


def measure(task: Collective, most_vehicles: int = 24, worlds_at_a_time: int = 64) -> Measure | None:
    """Return the compiled `task.measure`; None where vehicles are too many to compare all with all."""
    if task.vehicles > most_vehicles:
        return None
    numbers = _numbers(task)

    def compiled_measure(scenario: Scenario, pose: np.ndarray) -> Measured:
        shape = pose.shape[:2]
        observation = np.empty((*shape, task.observation_size), np.float32)
        reward, lost = np.empty(shape), np.zeros(shape[0], bool)
        collided, outside, at_target = (np.zeros(shape, bool) for _ in range(3))
        written = observation, reward, collided, outside, at_target, lost
        _measure(pose, scenario.target, numbers, task.config.sees_walls, worlds_at_a_time, *written)
        return Measured(observation, reward, Events(collided, outside, at_target), lost)

    return compiled_measure


def _numbers(task: Collective) -> Numbers:
    config, scaling = task.config, task.config.observation
    far_mm = config.lost_share * min(task.arena.high_mm - task.arena.low_mm)
    values = (
        *(scaling.target_mm, scaling.range_mm, scaling.neighbour_mm, scaling.closeness_mm, scaling.wall_closeness_mm),
        *(config.d_max_mm, config.target_near_mm, config.neighbour_near_mm, config.collision_mm, config.reach_mm),
        *(config.outside_mm, far_mm),
    )
    low_x, low_y, high_x, high_y = (np.float32(end) for end in (*task.arena.low_mm, *task.arena.high_mm))
    return Numbers((low_x, low_y, high_x, high_y), *(np.float32(value) for value in values))


@compiled
def _measure(pose, target, mm, sees_walls, width, observation, reward, collided, outside, at_target, lost):  # type: ignore[no-untyped-def]
    """Write what W worlds of K vehicles measure, `width` worlds at a time."""
    worlds, vehicles = pose.shape[:2]
    shape, number = (vehicles, width), np.float32
    x, y, cos, sin = np.zeros(shape, number), np.zeros(shape, number), np.ones(shape, number), np.zeros(shape, number)
    cost = np.zeros(shape, number)
    distance, close = np.full((vehicles, *shape), 1e30, number), np.empty((vehicles, *shape), number)
    target_x, target_y = np.zeros((1, width), number), np.zeros((1, width), number)
    forward, left, third = np.empty(width, number), np.empty(width, number), np.empty(width, number)
    fourth, fifth = np.empty(width, number), np.empty(width, number)
    hit, column = np.empty((vehicles, width), np.int32), np.empty(width, np.int32)
    for first in range(0, worlds, width):
        count = min(width, worlds - first)
        lanes.load(pose, first, count, x, y, cos, sin)
        for lane in range(count):
            target_x[0, lane], target_y[0, lane] = target[first + lane, 0], target[first + lane, 1]
            lost[first + lane] = False
        cost[:], hit[:] = 0, 0
        for own in range(vehicles):
            for other in range(own):
                _compare(x, y, own, other, mm, distance, close, cost, hit)
        for own in range(vehicles):
            lanes.see(x, y, cos, sin, own, target_x, target_y, 0, forward, left)
            lanes.show_target(forward, left, third, fourth, fifth, mm.target)
            for lane in range(width):
                away_mm = fifth[lane] * mm.target
                far_cost = np.float32(20.0) / mm.d_max * away_mm
                cost[own, lane] += np.float32(5.0) if away_mm < mm.target_near else far_cost
            for lane in range(count):
                world = first + lane
                _write(observation[world, own], 0, forward[lane], left[lane], third[lane], fourth[lane], fifth[lane])
                reward[world, own] = -cost[own, lane]
                at_target[world, own] = fifth[lane] * mm.target <= mm.reach
                collided[world, own] = hit[own, lane] > 0
                outside[world, own] = lanes.is_outside(x[own, lane], y[own, lane], mm.arena, mm.outside)
                lost[world] |= lanes.is_outside(x[own, lane], y[own, lane], mm.arena, mm.lost)
            for other in range(vehicles):
                if other == own:
                    continue
                lanes.see(x, y, cos, sin, own, x, y, other, forward, left)
                lanes.draw_in(forward, left, distance, own, other, mm.range, mm.neighbour)
                _find_column(distance, own, other, column)
                for lane in range(width):
                    fourth[lane] = cos[other, lane] * cos[own, lane] + sin[other, lane] * sin[own, lane]
                    fifth[lane] = sin[other, lane] * cos[own, lane] - cos[other, lane] * sin[own, lane]
                for lane in range(count):
                    row, closeness = observation[first + lane, own], close[own, other, lane]
                    _write(row, column[lane], forward[lane], left[lane], closeness, fourth[lane], fifth[lane])
            if sees_walls:
                after = 5 * vehicles
                lanes.write_walls(observation, first, after, x, y, cos, sin, own, mm.arena, mm.wall_closeness, count)


@compiled
def _write(row, column, first, second, third, fourth, fifth):  # type: ignore[no-untyped-def]
    """Write five numbers into a row, from a column on."""
    row[column] = first
    row[column + 1] = second
    row[column + 2] = third
    row[column + 3] = fourth
    row[column + 4] = fifth


@compiled
def _compare(x, y, own, other, mm, distance, close, cost, hit):  # type: ignore[no-untyped-def]
    """Write how far two vehicles are apart, how close that is, what it costs them, and whether they collide."""
    width = x.shape[1]
    for lane in range(width):
        away_x, away_y = x[other, lane] - x[own, lane], y[other, lane] - y[own, lane]
        apart_mm = math.sqrt(away_x * away_x + away_y * away_y)
        distance[own, other, lane] = apart_mm
        distance[other, own, lane] = apart_mm
        near_cost = np.float32(5.0) if apart_mm < mm.neighbour_near else np.float32(0.0)
        cost[own, lane] += near_cost
        cost[other, lane] += near_cost
        collide = np.int32(1) if apart_mm < mm.collision else np.int32(0)
        hit[own, lane] |= collide
        hit[other, lane] |= collide
    for lane in range(width):
        closeness = math.exp((mm.collision - distance[own, other, lane]) / mm.closeness)
        close[own, other, lane] = closeness
        close[other, own, lane] = closeness


@compiled
def _find_column(distance, own, other, column):  # type: ignore[no-untyped-def]
    """Write where one of the others is shown: after the target and those that are nearer, or as near and before it.

    A vehicle's distance from itself is huge, so that it is never nearer.
    """
    column[:] = 5
    for third in range(distance.shape[0]):
        for lane in range(distance.shape[2]):
            theirs, mine = distance[own, third, lane], distance[own, other, lane]
            is_nearer = theirs <= mine if third < other else theirs < mine
            column[lane] += np.int32(5) if is_nearer else np.int32(0)
