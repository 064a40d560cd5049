"""What transitions are in memory: aligned arrays, one row a transition."""

import dataclasses
import hashlib
from collections.abc import Callable, Collection, Iterator, Mapping
from dataclasses import dataclass, field
from typing import Literal, Self

import numpy as np

from swarmtwin.geometry import log_map
from swarmtwin.robot import Arena, Robot

Split = Literal["train", "validation", "test"]
SPLITS: tuple[Split, ...] = ("train", "validation", "test")

Fields = Mapping[str, np.ndarray]
"""Some arrays of `Transitions` by name, with the same rows each: all of them, or a block."""


@dataclass(frozen=True)
class Transitions:
    """N transitions as arrays, in order of run, vehicle and time.

    Attributes:
        robot: the robot they were measured on.
        arena_mm: where its vehicles could move, in the frame of the poses: the recording's arena, not the usual one.
        command: (N, m) held over the period, in the robot's units.
        previous_command: (N, m) held over the period before; NaN where there was none (start of a run, after a gap).
        earlier_command: (N, m) held over the period before that; NaN where there was none or no previous one.
        pose: (N, 3) x_mm, y_mm, heading_rad at the start, in the arena's frame.
        displacement: (N, 3) forward_mm, left_mm, turn_rad in the vehicle's frame at the start.
        neighbours: (N, K, 3) forward_mm, left_mm, turn_rad from the vehicle's pose at the start to those of the other
            vehicles of its run at that time; K is the most others in any run, 0 where vehicles drive alone and for
            synthetic transitions; a row of NaN where there are fewer or a pose is unknown.
        time_s: (N,) session time at the start.
        duration_s: (N,) measured length of the period.
        run: (N,) index into `runs`.
        vehicle: (N,) index into `vehicles`.
        split: (N,) index into `SPLITS`; all transitions of a run are in the same split.
        runs: names of the runs.
        vehicles: ids of the vehicles.
        velocity: (N, 3) forward_mm_s, left_mm_s, turn_rad_s: the twist of the displacement of the period before, over
            its measured length. A constant twist is the same at its beginning and at its end, so it is in the vehicle's
            frame at the start. A row of NaN where no transition ends at the start: the first row of a run, after a gap,
            after what was dropped. It carries the noise of two measured poses. Left out: taken from these transitions.
    """

    robot: Robot
    arena_mm: Arena
    command: np.ndarray
    previous_command: np.ndarray
    earlier_command: np.ndarray
    pose: np.ndarray
    displacement: np.ndarray
    neighbours: np.ndarray
    time_s: np.ndarray
    duration_s: np.ndarray
    run: np.ndarray
    vehicle: np.ndarray
    split: np.ndarray
    runs: tuple[str, ...]
    vehicles: tuple[str, ...]
    velocity: np.ndarray = field(default_factory=lambda: np.empty((0, 3)))

    def __post_init__(self) -> None:
        if len(self.velocity) != len(self):
            object.__setattr__(self, "velocity", self._velocity())

    def __len__(self) -> int:
        return len(self.time_s)

    def just_before(self) -> np.ndarray:
        """Return (N,) the transition of the same run and vehicle that ends where each one begins; −1: none.

        Times are compared to 2 ms, twice what they are rounded to.
        """
        return _just_before(self.run, self.vehicle, self.time_s, self.duration_s)

    def _velocity(self) -> np.ndarray:
        return velocity_before(self.displacement, self.run, self.vehicle, self.time_s, self.duration_s)

    def where(self, chosen: np.ndarray) -> Self:
        """Return the transitions chosen by a mask (N,) or by indices; `runs` and `vehicles` stay, so indices hold."""
        arrays = {
            part.name: value[chosen]
            for part in dataclasses.fields(self)
            if isinstance(value := getattr(self, part.name), np.ndarray)
        }
        return dataclasses.replace(self, **arrays)

    def blocks(self, names: Collection[str]) -> Iterator[Fields]:
        """Yield the arrays of these names, all rows at once: see `TransitionSource`."""
        yield {name: getattr(self, name) for name in names}

    def chosen(self, choose: Callable[[np.ndarray, np.ndarray], np.ndarray]) -> Self:
        """Return the transitions that a function of their run and split, (N,) each, chooses by a mask (N,)."""
        return self.where(choose(self.run, self.split))

    def count(self, split: Split) -> int:
        """Return how many transitions a split has."""
        return int(np.count_nonzero(self.split == SPLITS.index(split)))

    def digest(self) -> str:
        """Identify the content: every number, and the names of the runs and vehicles.

        Velocities count where the robot's models are given them; otherwise they follow from the rest.
        """
        content = hashlib.sha256(repr((self.runs, self.vehicles)).encode())
        for name in digested_fields(self.robot):
            content.update(getattr(self, name).tobytes())
        return content.hexdigest()[:16]

    def digests(self) -> dict[Split, str]:
        """Return the digest of each split's transitions."""
        return {split: self.part(split).digest() for split in SPLITS}

    def part(self, split: Split) -> Self:
        """Return the transitions of one split."""
        return self.where(self.split == SPLITS.index(split))


def array_fields() -> tuple[str, ...]:
    """Return the names of the fields of `Transitions` that are arrays with a row a transition, in their order."""
    apart = ("robot", "arena_mm", "runs", "vehicles")
    return tuple(part.name for part in dataclasses.fields(Transitions) if part.name not in apart)


def digested_fields(robot: Robot) -> tuple[str, ...]:
    """Return the names of the arrays that a digest takes in, in this order."""
    return tuple(name for name in array_fields() if name != "velocity" or name in robot.situation)


def velocity_before(
    displacement: np.ndarray, run: np.ndarray, vehicle: np.ndarray, time_s: np.ndarray, duration_s: np.ndarray
) -> np.ndarray:
    """Return (N, 3) the twist with which the transition just before each one ends, NaN where there is none.

    Args:
        displacement: (N, 3) of transitions in order of run, vehicle and time; the others (N,), as in `Transitions`.
        run: index of the run.
        vehicle: index of the vehicle.
        time_s: at the start.
        duration_s: of the period.
    """
    before = _just_before(run, vehicle, time_s, duration_s)
    twist = log_map(displacement) / duration_s[:, None]
    return np.where((before >= 0)[:, None], twist[before], np.nan)


def _just_before(run: np.ndarray, vehicle: np.ndarray, time_s: np.ndarray, duration_s: np.ndarray) -> np.ndarray:
    same = (run[1:] == run[:-1]) & (vehicle[1:] == vehicle[:-1])
    same &= np.abs(time_s[1:] - (time_s + duration_s)[:-1]) < 2e-3
    before = np.full(len(run), -1)
    before[1:][same] = np.flatnonzero(same)
    return before
