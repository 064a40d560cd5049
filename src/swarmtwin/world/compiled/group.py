"""What the tasks of groups (`world/group.py`) measure, compiled: a vehicle's place, the others and the walls."""

import math
from typing import Any, NamedTuple

import numpy as np

from swarmtwin.compiled import compiled
from swarmtwin.world.compiled import lanes
from swarmtwin.world.compiled.elementary import exponential


class Numbers(NamedTuple):
    """The numbers of a task's configuration, float32, in mm; `arena` is x and y of its low, then of its high corner."""

    arena: tuple[np.float32, np.float32, np.float32, np.float32]
    target: np.float32
    range: np.float32
    neighbour: np.float32
    closeness: np.float32
    wall_closeness: np.float32
    neighbour_near: np.float32
    collision: np.float32
    within: np.float32
    outside: np.float32
    lost: np.float32

    @classmethod
    def of(cls, arena: tuple[float, ...], within_mm: float | None, **others: float) -> "Numbers":
        """Return them as float32; `within_mm` None: everybody is seen."""
        low_x, low_y, high_x, high_y = (np.float32(end) for end in arena)
        within = np.float32(1e30 if within_mm is None else within_mm)
        values = {name: np.float32(value) for name, value in others.items()}
        return cls((low_x, low_y, high_x, high_y), within=within, **values)


class Seen(NamedTuple):
    """What W worlds of K vehicles show.

    Attributes:
        observation: (W, K, o) float32.
        near_others: (W, K) how many others are near, float32.
        place_mm: (W, K) how far the place is that a vehicle is shown, float32.
        collided: (W, K) whether another one is too near.
        outside: (W, K) whether a vehicle is outside the arena.
        lost: (W,) whether one is too far outside to go on.
    """

    observation: np.ndarray
    near_others: np.ndarray
    place_mm: np.ndarray
    collided: np.ndarray
    outside: np.ndarray
    lost: np.ndarray


def look(
    pose: np.ndarray, place: np.ndarray, numbers: Numbers, shown: int, sees_walls: bool, all_pairs_up_to: int = 20
) -> Seen:
    """Return what vehicles at poses (W, K, 3) see, and what happens to them.

    Args:
        pose: x_mm, y_mm, heading_rad.
        place: (W, K, 2), or (W, 1, 2), that each is shown.
        numbers: of the task.
        shown: how many others, the nearest ones, each is shown.
        sees_walls: whether it is shown the walls.
        all_pairs_up_to: in larger groups neighbours are looked for in a grid, whose effort does not grow with K².
    """
    shape = pose.shape[:2]
    observation = np.empty((*shape, 5 + 5 * shown + 8 * sees_walls), np.float32)
    flags = np.zeros(shape, bool), np.zeros(shape, bool), np.zeros(shape[0], bool)
    seen = Seen(observation, np.empty(shape, np.float32), np.empty(shape, np.float32), *flags)
    kernel: Any = _compare_all if shape[1] <= all_pairs_up_to else _look_about
    kernel(np.ascontiguousarray(pose), np.ascontiguousarray(place), numbers, shown, sees_walls, *seen)
    return seen


@compiled
def _compare_all(  # type: ignore[no-untyped-def]
    pose, place, mm, shown, sees_walls, observation, near_others, place_mm, collided, outside, lost, width=64
):
    """Write what W worlds of K vehicles measure, all compared with all, `width` worlds at a time."""
    worlds, vehicles = pose.shape[:2]
    shape, number = (vehicles, width), np.float32
    x, y, cos, sin = np.zeros(shape, number), np.zeros(shape, number), np.ones(shape, number), np.zeros(shape, number)
    distance, close = np.full((vehicles, *shape), 1e30, number), np.empty((vehicles, *shape), number)
    place_x, place_y = np.zeros((1, width), number), np.zeros((1, width), number)
    forward, left, third = np.empty(width, number), np.empty(width, number), np.empty(width, number)
    fourth, fifth, away = np.empty(width, number), np.empty(width, number), np.empty(width, number)
    near, hit, column = np.empty(shape, np.int32), np.empty(shape, np.int32), np.empty(width, np.int32)
    are_all_shown = shown == vehicles - 1 and mm.within >= 1e30
    for first in range(0, worlds, width):
        count = min(width, worlds - first)
        lanes.load(pose, first, count, x, y, cos, sin)
        near[:], hit[:] = 0, 0
        for own in range(vehicles):
            for other in range(own):
                _compare(x, y, own, other, mm, distance, close, near, hit)
        for own in range(vehicles):
            for lane in range(count):
                place_x[0, lane] = place[first + lane, own % place.shape[1], 0]
                place_y[0, lane] = place[first + lane, own % place.shape[1], 1]
            lanes.see(x, y, cos, sin, own, place_x, place_y, 0, forward, left)
            lanes.show_place(forward, left, third, fourth, fifth, away, mm.target)
            for lane in range(count):
                world = first + lane
                _write(observation[world, own], 0, forward[lane], left[lane], third[lane], fourth[lane], fifth[lane])
                near_others[world, own] = near[own, lane]
                place_mm[world, own] = away[lane]
                collided[world, own] = hit[own, lane] > 0
                outside[world, own] = lanes.is_outside(x[own, lane], y[own, lane], mm.arena, mm.outside)
                lost[world] |= lanes.is_outside(x[own, lane], y[own, lane], mm.arena, mm.lost)
            if not are_all_shown:
                for lane in range(count):
                    for rank in range(shown):
                        _write_nobody(observation[first + lane, own], 5 + 5 * rank, mm)
            for other in range(vehicles):
                if other == own:
                    continue
                lanes.see(x, y, cos, sin, own, x, y, other, forward, left)
                lanes.draw_in(forward, left, distance, own, other, mm.range, mm.neighbour)
                _find_column(distance, own, other, column)
                for lane in range(width):
                    fourth[lane] = cos[other, lane] * cos[own, lane] + sin[other, lane] * sin[own, lane]
                    fifth[lane] = sin[other, lane] * cos[own, lane] - cos[other, lane] * sin[own, lane]
                if are_all_shown:
                    for lane in range(count):
                        row, closeness = observation[first + lane, own], close[own, other, lane]
                        _write(row, column[lane], forward[lane], left[lane], closeness, fourth[lane], fifth[lane])
                    continue
                for lane in range(count):
                    row, closeness = observation[first + lane, own], close[own, other, lane]
                    if column[lane] <= 5 * shown and distance[own, other, lane] <= mm.within:
                        _write(row, column[lane], forward[lane], left[lane], closeness, fourth[lane], fifth[lane])
            if sees_walls:
                after = 5 + 5 * shown
                lanes.write_walls(observation, first, after, x, y, cos, sin, own, mm.arena, mm.wall_closeness, count)


@compiled
def _compare(x, y, own, other, mm, distance, close, near, hit):  # type: ignore[no-untyped-def]
    """Write how far two vehicles are apart, how close that is, whether they are near each other, and collide."""
    width = x.shape[1]
    for lane in range(width):
        away_x, away_y = x[other, lane] - x[own, lane], y[other, lane] - y[own, lane]
        apart_mm = math.sqrt(away_x * away_x + away_y * away_y)
        distance[own, other, lane] = apart_mm
        distance[other, own, lane] = apart_mm
        is_near = np.int32(1) if apart_mm < mm.neighbour_near else np.int32(0)
        near[own, lane] += is_near
        near[other, lane] += is_near
        collide = np.int32(1) if apart_mm < mm.collision else np.int32(0)
        hit[own, lane] |= collide
        hit[other, lane] |= collide
    for lane in range(width):
        closeness = exponential((mm.collision - distance[own, other, lane]) / mm.closeness)
        close[own, other, lane] = closeness
        close[other, own, lane] = closeness


@compiled
def _find_column(distance, own, other, column):  # type: ignore[no-untyped-def]
    """Write where one of the others is shown: after the place and those that are nearer, or as near and before it.

    A vehicle's distance from itself is huge, so that it is never nearer.
    """
    column[:] = 5
    for third in range(distance.shape[0]):
        for lane in range(distance.shape[2]):
            theirs, mine = distance[own, third, lane], distance[own, other, lane]
            is_nearer = theirs <= mine if third < other else theirs < mine
            column[lane] += np.int32(5) if is_nearer else np.int32(0)


@compiled
def _look_about(pose, place, mm, shown, sees_walls, observation, near_others, place_mm, collided, outside, lost):  # type: ignore[no-untyped-def]
    """Write the same of large groups: each vehicle looks for others in a grid, in one ring of cells after the other."""
    worlds, vehicles = pose.shape[:2]
    shape, number = (vehicles, 1), np.float32
    x, y, cos, sin = np.empty(shape, number), np.empty(shape, number), np.empty(shape, number), np.empty(shape, number)
    place_x, place_y = np.empty((1, 1), number), np.empty((1, 1), number)
    forward, left, third = np.empty(1, number), np.empty(1, number), np.empty(1, number)
    fourth, fifth, away = np.empty(1, number), np.empty(1, number), np.empty(1, number)
    kept, reach_mm = min(shown, vehicles - 1), max(mm.neighbour_near, mm.collision)
    found, found_mm = np.empty(kept + 1, np.int64), np.empty(kept + 1, number)
    low_x, low_y, high_x, high_y = mm.arena
    side_mm = math.sqrt((high_x - low_x) * (high_y - low_y) / vehicles)
    columns, rows = int((high_x - low_x) / side_mm) + 1, int((high_y - low_y) / side_mm) + 1
    cell, member, begin = (
        np.empty(vehicles, np.int64),
        np.empty(vehicles, np.int64),
        np.empty(columns * rows + 1, np.int64),
    )
    for world in range(worlds):
        lanes.load(pose, world, 1, x, y, cos, sin)
        _sort_into_cells(x, y, low_x, low_y, side_mm, columns, rows, cell, member, begin)
        for own in range(vehicles):
            there, near, ring = 0, 0, 0
            own_column, own_row = cell[own] % columns, cell[own] // columns
            searching = True
            while searching:
                for at_row in range(max(own_row - ring, 0), min(own_row + ring, rows - 1) + 1):
                    step = 1 if abs(at_row - own_row) == ring else 2 * ring
                    for at_column in range(own_column - ring, own_column + ring + 1, max(step, 1)):
                        if at_column < 0 or at_column >= columns:
                            continue
                        at = at_row * columns + at_column
                        for index in range(begin[at], begin[at + 1]):
                            other = member[index]
                            away_x, away_y = x[other, 0] - x[own, 0], y[other, 0] - y[own, 0]
                            away_mm = math.sqrt(away_x * away_x + away_y * away_y)
                            if other != own:
                                near += 1 if away_mm < mm.neighbour_near else 0
                                collided[world, own] |= away_mm < mm.collision
                                if away_mm <= mm.within:
                                    there = _insert(found, found_mm, there, kept, other, away_mm)
                seen_mm = ring * side_mm
                is_enough = seen_mm > mm.within or kept == 0 or (there == kept and found_mm[kept - 1] < seen_mm)
                searching = ring < max(columns, rows) and not (is_enough and seen_mm >= reach_mm)
                ring += 1
            near_others[world, own] = near
            outside[world, own] = lanes.is_outside(x[own, 0], y[own, 0], mm.arena, mm.outside)
            lost[world] |= lanes.is_outside(x[own, 0], y[own, 0], mm.arena, mm.lost)
            row = observation[world, own]
            place_x[0, 0] = place[world, own % place.shape[1], 0]
            place_y[0, 0] = place[world, own % place.shape[1], 1]
            lanes.see(x, y, cos, sin, own, place_x, place_y, 0, forward, left)
            lanes.show_place(forward, left, third, fourth, fifth, away, mm.target)
            place_mm[world, own] = away[0]
            _write(row, 0, forward[0], left[0], third[0], fourth[0], fifth[0])
            for rank in range(there):
                other, away_mm = found[rank], found_mm[rank]
                drawn_in = min(number(1.0), mm.range / max(away_mm, number(1e-6))) / mm.neighbour
                lanes.see(x, y, cos, sin, own, x, y, other, forward, left)
                relative_cos = cos[other, 0] * cos[own, 0] + sin[other, 0] * sin[own, 0]
                relative_sin = sin[other, 0] * cos[own, 0] - cos[other, 0] * sin[own, 0]
                closeness = exponential((mm.collision - away_mm) / mm.closeness)
                _write(
                    row, 5 + 5 * rank, forward[0] * drawn_in, left[0] * drawn_in, closeness, relative_cos, relative_sin
                )
            for rank in range(there, shown):
                _write_nobody(row, 5 + 5 * rank, mm)
            if sees_walls:
                after = 5 + 5 * shown
                lanes.write_walls(observation, world, after, x, y, cos, sin, own, mm.arena, mm.wall_closeness, 1)


@compiled
def _sort_into_cells(x, y, low_x, low_y, side_mm, columns, rows, cell, member, begin):  # type: ignore[no-untyped-def]
    """Write each vehicle's cell, outside that nearest, and who is in cell c: `member[begin[c] : begin[c + 1]]`."""
    begin[:] = 0
    for vehicle in range(len(cell)):
        column = min(max(math.floor((x[vehicle, 0] - low_x) / side_mm), 0), columns - 1)
        row = min(max(math.floor((y[vehicle, 0] - low_y) / side_mm), 0), rows - 1)
        cell[vehicle] = row * columns + column
        begin[cell[vehicle]] += 1
    for index in range(1, len(begin)):
        begin[index] += begin[index - 1]
    for vehicle in range(len(cell)):
        begin[cell[vehicle]] -= 1
        member[begin[cell[vehicle]]] = vehicle


@compiled
def _insert(found, found_mm, there, kept, other, away_mm):  # type: ignore[no-untyped-def]
    """Insert a vehicle among the nearest `there` found, of which up to `kept` stay; return how many there are now."""
    place = there
    while place > 0 and (
        away_mm < found_mm[place - 1] or (away_mm == found_mm[place - 1] and other < found[place - 1])
    ):
        found[place], found_mm[place] = found[place - 1], found_mm[place - 1]
        place -= 1
    found[place], found_mm[place] = other, away_mm
    return min(there + 1, kept)


@compiled
def _write(row, column, first, second, third, fourth, fifth):  # type: ignore[no-untyped-def]
    """Write five numbers into a row, from a column on."""
    row[column] = first
    row[column + 1] = second
    row[column + 2] = third
    row[column + 3] = fourth
    row[column + 4] = fifth


@compiled
def _write_nobody(row, column, mm):  # type: ignore[no-untyped-def]
    """Write that nobody is there: straight behind at the edge of the range."""
    none = np.float32(0.0)
    _write(row, column, -mm.range / mm.neighbour, none, none, none, none)
