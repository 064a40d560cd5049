"""Transitions from a recording's tracks, and the count of those that are not to be believed, by reason."""

import logging
from collections import Counter
from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from swarmtwin.errors import UserError
from swarmtwin.geometry import displacement_between
from swarmtwin.recordings.recording import Recording
from swarmtwin.recordings.rows import Rows, at_most
from swarmtwin.robot import Robot
from swarmtwin.transitions.neighbours import neighbours_at, others_of
from swarmtwin.transitions.teleports import doubtful_rows, teleports
from swarmtwin.transitions.transitions import SPLITS, Transitions

# Why a transition is dropped, in the order of the checks: each is counted under the first that applies.
REASONS = {
    "no_command": "no command at the start",
    "command_out_of_limits": "the command is beyond the robot's limits",
    "gap": "longer than the robot's longest gap",
    "short_period": "shorter than half the period",
    "no_pose": "no pose at the start or at the end",
    "doubtful_marker": "the marker had jumped away and not come back",
    "teleport": "far beyond believable motion: a swapped or misread marker",
    "outside_arena": "start and end both outside the arena",
    "outlier": "beyond believable motion",
}

logger = logging.getLogger(__name__)


@dataclass(frozen=True)
class Counts:
    """What became of a recording's rows.

    Attributes:
        rows: rows of all tracks, those set aside while reading left out.
        dropped_rows: rows set aside while reading, by reason.
        considered: pairs of successive rows of one vehicle in one run.
        kept: pairs that became transitions.
        dropped: pairs that did not, by the first reason in `REASONS` that applies; considered = kept + these.
    """

    rows: int
    dropped_rows: Mapping[str, int]
    considered: int
    kept: int
    dropped: Mapping[str, int]

    def __add__(self, other: "Counts") -> "Counts":
        """Count two parts together."""
        dropped = {name: self.dropped.get(name, 0) + other.dropped.get(name, 0) for name in REASONS}
        return Counts(
            rows=self.rows + other.rows,
            dropped_rows=dict(Counter(self.dropped_rows) + Counter(other.dropped_rows)),
            considered=self.considered + other.considered,
            kept=self.kept + other.kept,
            dropped={name: count for name, count in dropped.items() if count},
        )

    def check(self, robot: Robot) -> None:
        """Check that something is left, and log what is not.

        Raises:
            UserError: nothing is left.
        """
        if not self.considered:
            raise UserError(
                f"recording of robot {robot.name!r}: no vehicle has two rows in one run: record longer runs"
            )
        listed = ", ".join(f"{name} {count}" for name, count in self.dropped.items())
        if listed:
            logger.info("%d of %d transitions kept; dropped: %s", self.kept, self.considered, listed)
        if not self.kept:
            raise UserError(
                f"recording of robot {robot.name!r}: no transition is left of {self.considered}, dropped: {listed}"
            )


def from_recording(recording: Recording) -> tuple[Transitions, Counts]:
    """Make the transitions of a recording, all in the split "train", and count what was dropped and why.

    A transition leads from a row to the vehicle's next row, if both poses are known, the command is known and allowed,
    and the time between lies between half a period and the robot's longest gap. Dropped as well is what is not to be
    believed:
    - outside the arena: as the authors, a transition stays unless BOTH poses are outside; outside means here that the
      whole vehicle is beyond the edge, by half its length, since cameras and drivers err a little at the edge. (One
      pose that is far outside makes an outlier or a teleport.)
    - outlier: more than `robot.largest_displacement` in proportion to the time, as in the authors' preprocessing.
    - teleport and doubtful marker: see `markers`.

    Neighbours are seen in all rows of the other vehicles, also in those that make no transition: see `neighbours`.

    Raises:
        UserError: nothing is left.
    """
    transitions, counts = from_part(recording)
    counts.check(recording.robot)
    return transitions, counts


def from_part(recording: Recording) -> tuple[Transitions, Counts]:
    """Make the transitions of whole runs, at least one, as `from_recording` does; here nothing may be left."""
    robot = recording.robot
    rows = Rows.of(recording.tracks)
    start = rows.starts()
    duration_s = rows.time_s[start + 1] - rows.time_s[start]
    displacement = displacement_between(rows.pose[start], rows.pose[start + 1])
    doubtful = doubtful_rows(rows, robot)
    reason = _first_reason(rows, start, duration_s, displacement, doubtful, recording)
    kept = reason < 0
    previous_command, earlier_command = _commands_before(rows, robot)
    start = start[kept]
    transitions = Transitions(
        robot=robot,
        arena_mm=recording.header.arena_mm,
        command=rows.command[start],
        previous_command=previous_command[start],
        earlier_command=earlier_command[start],
        pose=rows.pose[start],
        displacement=displacement[kept],
        neighbours=_neighbours(rows, start, doubtful, recording),
        time_s=rows.time_s[start],
        duration_s=duration_s[kept],
        run=rows.run[start],
        vehicle=rows.vehicle[start],
        split=np.full(len(start), SPLITS.index("train"), dtype=np.int8),
        runs=rows.runs,
        vehicles=rows.vehicles,
    )
    return transitions, _counts(rows, recording, reason)


def _first_reason(
    rows: Rows,
    start: np.ndarray,
    duration_s: np.ndarray,
    displacement: np.ndarray,
    doubtful: np.ndarray,
    recording: Recording,
) -> np.ndarray:
    """Return (P,) the index into `REASONS` of the first that applies to each pair of rows, or −1."""
    robot = recording.robot
    periods = duration_s / robot.period_s
    outside = _outside(rows.pose, recording)
    applies = {
        "no_command": np.isnan(rows.command[start]).any(axis=1),
        "command_out_of_limits": _out_of_limits(rows.command, robot)[start],
        "gap": _gap(duration_s, robot),
        "short_period": _short(duration_s, robot),
        "no_pose": np.isnan(displacement).any(axis=1),
        "doubtful_marker": doubtful[start] & doubtful[start + 1],
        "teleport": teleports(displacement, periods, robot) | (doubtful[start] != doubtful[start + 1]),
        "outside_arena": outside[start] & outside[start + 1],
        "outlier": (np.abs(displacement) > robot.displacement_limit * periods[:, None]).any(axis=1),
    }
    stacked = np.stack([applies[name] for name in REASONS])
    return np.where(stacked.any(axis=0), np.argmax(stacked, axis=0), -1)


def _commands_before(rows: Rows, robot: Robot) -> tuple[np.ndarray, np.ndarray]:
    """Return the commands (R, m) of the row before and of the one before that.

    NaN where a command was not held until the next row or was not allowed, and before that.
    """
    previous, earlier = np.full_like(rows.command, np.nan), np.full_like(rows.command, np.nan)
    start = rows.starts()
    duration_s = rows.time_s[start + 1] - rows.time_s[start]
    held = ~_gap(duration_s, robot) & ~_short(duration_s, robot) & ~_out_of_limits(rows.command, robot)[start]
    previous[start[held] + 1] = rows.command[start[held]]
    earlier[start[held] + 1] = previous[start[held]]
    return previous, np.where(np.isnan(previous), np.nan, earlier)


def _neighbours(rows: Rows, start: np.ndarray, doubtful: np.ndarray, recording: Recording) -> np.ndarray:
    """Return (P, K, 3) the relative poses of the other vehicles; one with a doubtful marker is nowhere."""
    believed = np.where(doubtful[:, None], np.nan, rows.pose)
    others = others_of([track.run for track in recording.tracks])
    return neighbours_at(start, rows.track, rows.time_s, believed, others, recording.robot)


def _out_of_limits(command: np.ndarray, robot: Robot) -> np.ndarray:
    return np.any((command < robot.command_low) | (command > robot.command_high), axis=1)


def _gap(duration_s: np.ndarray, robot: Robot) -> np.ndarray:
    return ~at_most(duration_s, robot.longest_gap_s)


def _short(duration_s: np.ndarray, robot: Robot) -> np.ndarray:
    return ~at_most(robot.period_s / 2, duration_s)


def _outside(pose: np.ndarray, recording: Recording) -> np.ndarray:
    arena, margin_mm = recording.header.arena_mm, max(recording.robot.vehicle_size_mm) / 2
    position = pose[:, :2]
    return np.any((position < arena.low_mm - margin_mm) | (position > arena.high_mm + margin_mm), axis=1)


def _counts(rows: Rows, recording: Recording, reason: np.ndarray) -> Counts:
    by_reason = np.bincount(reason[reason >= 0], minlength=len(REASONS))
    dropped = {name: int(count) for name, count in zip(REASONS, by_reason, strict=True) if count}
    return Counts(
        rows=len(rows),
        dropped_rows=dict(recording.dropped_rows),
        considered=len(reason),
        kept=int((reason < 0).sum()),
        dropped=dropped,
    )
