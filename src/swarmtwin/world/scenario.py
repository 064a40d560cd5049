"""Where roll-outs begin and what is asked of the vehicles: the same scenario can be played by any motion."""

import json
from collections.abc import Callable, Sequence
from dataclasses import dataclass, fields, replace

import numpy as np


@dataclass(frozen=True)
class Scenario:
    """W worlds of K vehicles, each with G targets one after the other and O round obstacles, in the arena's frame.

    Attributes:
        start: (W, K, 3) x_mm, y_mm, heading_rad.
        targets: (W, G, 2) x_mm, y_mm in the order in which they are to be reached; (W, G, K, 2) where each vehicle has
            its own. NaN where there are none.
        obstacles: (W, O, 3) x_mm, y_mm, radius_mm.
        leg: (W,) index of the target that is sought now; all vehicles of a world seek the same.
    """

    start: np.ndarray
    targets: np.ndarray
    obstacles: np.ndarray
    leg: np.ndarray

    @classmethod
    def beginning(cls, start: np.ndarray, targets: np.ndarray, obstacles: np.ndarray | None = None) -> "Scenario":
        """Return a scenario in which every world seeks its first target; without `obstacles` there are none."""
        worlds = len(start)
        obstacles = np.empty((worlds, 0, 3)) if obstacles is None else obstacles
        return cls(start, targets, obstacles, np.zeros(worlds, dtype=int))

    @classmethod
    def joined(cls, parts: Sequence["Scenario"]) -> "Scenario":
        """Return the worlds of several scenarios, one after the other."""
        return cls(**{f.name: np.concatenate([getattr(part, f.name) for part in parts]) for f in fields(cls)})

    def __len__(self) -> int:
        return len(self.start)

    @property
    def target(self) -> np.ndarray:
        """The targets sought now, (W, 2), or (W, K, 2) where each vehicle has its own."""
        if self.targets.shape[1] == 1:
            return self.targets[:, 0]
        target: np.ndarray = self.targets[np.arange(len(self)), self.leg]
        return target

    @property
    def target_of_each(self) -> np.ndarray:
        """The target that each vehicle seeks now, (W, K, 2), or (W, 1, 2) where it is the same for all."""
        return for_each_vehicle(self.target)

    @property
    def on_last_leg(self) -> np.ndarray:
        """Whether no further target follows, (W,)."""
        last: np.ndarray = self.leg == self.targets.shape[1] - 1
        return last

    def where(self, worlds: np.ndarray) -> "Scenario":
        """Return some worlds: indices (n,) or a mask (W,)."""
        return Scenario(**{field.name: getattr(self, field.name)[worlds] for field in fields(self)})

    def copy(self) -> "Scenario":
        """Return the same scenario with arrays of its own."""
        return Scenario(**{field.name: getattr(self, field.name).copy() for field in fields(self)})

    def put(self, worlds: np.ndarray, other: "Scenario") -> None:
        """Write the n worlds of another scenario over those at indices (n,)."""
        for field in fields(self):
            getattr(self, field.name)[worlds] = getattr(other, field.name)

    def advanced(self, worlds: np.ndarray) -> "Scenario":
        """Return this scenario with the worlds of a mask (W,) seeking their next target, where there is one."""
        return replace(self, leg=self.leg + (worlds & ~self.on_last_leg))

    def from_first_leg(self) -> "Scenario":
        """Return this scenario with every world seeking its first target."""
        return replace(self, leg=np.zeros_like(self.leg))


class ScenarioSupply:
    """Scenarios drawn many at a time, which costs far less than one by one, and handed out one after the other."""

    def __init__(self, draw: Callable[[np.random.Generator, int], Scenario], at_a_time: int, seed: int) -> None:
        """Draw with a task's `draw`, `at_a_time` or more, from a seed."""
        self._draw = draw
        self._at_a_time = at_a_time
        self._next = 0
        self.reseed(seed)

    def reseed(self, seed: int) -> None:
        """Forget what has been drawn; draw from now on from another seed."""
        self._rng = np.random.default_rng(seed)
        self._refill()

    def take(self, count: int) -> Scenario:
        """Return the next `count` scenarios."""
        parts = []
        while count:
            if self._next == len(self._drawn):
                self._refill()
            upto = min(self._next + count, len(self._drawn))
            parts.append(self._drawn.where(np.arange(self._next, upto)))
            count -= upto - self._next
            self._next = upto
        return parts[0] if len(parts) == 1 else Scenario.joined(parts)

    def state(self) -> str:
        """Return all that the next scenarios depend on, as text."""
        return json.dumps([self._before, self._next])

    def restore(self, state: str) -> None:
        """Continue from a `state`."""
        self._rng.bit_generator.state, following = json.loads(state)
        self._refill()
        self._next = following

    def _refill(self) -> None:
        self._before = self._rng.bit_generator.state
        self._drawn = self._draw(self._rng, self._at_a_time)
        self._next = 0


def for_each_vehicle(target: np.ndarray) -> np.ndarray:
    """Return targets of a moment, (W, 2) or (W, K, 2), in a shape that goes with K vehicles: (W, 1, 2) or (W, K, 2)."""
    return target[:, None] if target.ndim == 2 else target


def inner_room(low_mm: np.ndarray, high_mm: np.ndarray, share: float) -> tuple[np.ndarray, np.ndarray]:
    """Return the corners (2,) of the rectangle within another that has the same centre and a share of its sides."""
    centre, half = (low_mm + high_mm) / 2, share * (high_mm - low_mm) / 2
    return centre - half, centre + half


def draw_apart(
    rng: np.random.Generator,
    count: int,
    room_mm: tuple[np.ndarray, np.ndarray],
    apart_mm: float,
    taken: np.ndarray,
    tries: int = 200,
) -> np.ndarray:
    """Draw `count` uniform places in each of W rectangles, each at least `apart_mm` from the others.

    Args:
        rng: what they are drawn with.
        count: places in a rectangle; `room_for` says how many there may be.
        room_mm: the rectangle's corners, (2,) and (2,).
        apart_mm: least distance between two places of a rectangle.
        taken: (W, n, 3) x_mm, y_mm, radius_mm of circles in which no place may lie.
        tries: how often a place is drawn before its rectangle is emptied and filled anew.

    Returns:
        (W, count, 2).
    """
    places = np.full((len(taken), count, 2), np.nan)
    unfinished = np.arange(len(taken))
    while len(unfinished):
        places[unfinished] = np.nan
        for index in range(count):
            worlds = unfinished
            for _ in range(tries):
                drawn = rng.uniform(*room_mm, (len(worlds), 2))
                near_another = _distance_mm(places[worlds, :index], drawn) < apart_mm
                in_circle = _distance_mm(taken[worlds, :, :2], drawn) < taken[worlds, :, 2]
                free = ~(near_another.any(axis=1) | in_circle.any(axis=1))
                places[worlds[free], index] = drawn[free]
                worlds = worlds[~free]
                if not len(worlds):
                    break
        unfinished = np.flatnonzero(np.isnan(places).any(axis=(1, 2)))
    return places


def _distance_mm(places: np.ndarray, drawn: np.ndarray) -> np.ndarray:
    """Return the distances (W, n) from places (W, n, 2) to one drawn place each (W, 2)."""
    away = places - drawn[:, None]
    return np.hypot(away[..., 0], away[..., 1])


def room_for(
    count: int, room_mm: tuple[np.ndarray, np.ndarray], apart_mm: float, taken: np.ndarray, filling: float = 0.85
) -> int:
    """Return `count`, or how many places can be drawn in the rectangle without many tries, where that is less.

    Random places block each other long before the rectangle is full; so they are counted by trying with 5,000
    candidates.

    Args:
        count: places wanted.
        room_mm: the rectangle's corners, (2,) and (2,).
        apart_mm: least distance between two places.
        taken: (n, 3) x_mm, y_mm, radius_mm of circles in which no place may lie.
        filling: the share of what can be reached that is still drawn quickly.
    """
    area = np.prod(room_mm[1] - room_mm[0])
    blocked = np.pi * ((count - 1) * apart_mm**2 + (taken[:, 2] ** 2).sum())
    if blocked < filling * area:
        return count
    candidates = np.random.default_rng(0).uniform(*room_mm, (5_000, 2))
    for x_mm, y_mm, radius_mm in taken:
        candidates = candidates[np.hypot(*(candidates - (x_mm, y_mm)).T) >= radius_mm]
    reached = 0
    while len(candidates):
        candidates = candidates[np.hypot(*(candidates - candidates[0]).T) >= max(apart_mm, 1e-9)]
        reached += 1
    return min(count, max(1, int(filling * reached)))
