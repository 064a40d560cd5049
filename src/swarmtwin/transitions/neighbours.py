"""Where the other vehicles of a run are at the start of each period, in the vehicle's own frame."""

from collections import defaultdict
from collections.abc import Hashable, Sequence
from dataclasses import dataclass
from typing import Self

import numpy as np

from swarmtwin.geometry import displacement_between, wrap_angle
from swarmtwin.recordings.rows import at_most
from swarmtwin.robot import Robot


def relative_poses(pose: np.ndarray) -> np.ndarray:
    """Return (..., V, V − 1, 3) what each of V vehicles sees of the others at poses (..., V, 3), in their order."""
    vehicles = pose.shape[-2]
    others = np.array([[other for other in range(vehicles) if other != own] for own in range(vehicles)], dtype=int)
    seen: np.ndarray = displacement_between(pose[..., :, None, :], pose[..., others, :])
    return seen


def others_of(runs: Sequence[Hashable]) -> np.ndarray:
    """Return (T, K) the other tracks in the run of each of T tracks, in order; −1 where there are fewer than K.

    Args:
        runs: the run of each track.
    """
    members: dict[Hashable, list[int]] = defaultdict(list)
    for track, run in enumerate(runs):
        members[run].append(track)
    others = np.full((len(runs), max(map(len, members.values()), default=1) - 1), -1)
    for together in members.values():
        for track in together:
            others[track, : len(together) - 1] = [other for other in together if other != track]
    return others


@dataclass(frozen=True)
class Moments:
    """Between which rows of another track each of Q moments lies; any shape in place of Q.

    Attributes:
        before: (Q,) the track's last row at that moment or earlier.
        after: (Q,) its next row.
        since_s: (Q,) time since the row before, infinite where there is none.
        until_s: (Q,) time until the row after, likewise.
    """

    before: np.ndarray
    after: np.ndarray
    since_s: np.ndarray
    until_s: np.ndarray

    @classmethod
    def of(cls, track: np.ndarray, time_s: np.ndarray, row: np.ndarray, other: np.ndarray) -> Self:
        """Find the times of rows among those of other tracks.

        Args:
            track: (R,) of each row, ascending.
            time_s: (R,) of each row, ascending within a track.
            row: (Q,) the rows whose times are meant.
            other: (Q,) the tracks to look into, −1 for none.
        """
        times, rank = np.unique(time_s, return_inverse=True)  # whole numbers, so that equal times are found as equal
        after = np.searchsorted(track * len(times) + rank, other * len(times) + rank[row], side="right")
        before, after = np.maximum(after - 1, 0), np.minimum(after, len(track) - 1)
        since_s, until_s = time_s[row] - time_s[before], time_s[after] - time_s[row]
        return cls(
            before,
            after,
            np.where((track[before] == other) & (since_s >= 0), since_s, np.inf),
            np.where((track[after] == other) & (until_s > 0), until_s, np.inf),
        )

    def __getitem__(self, chosen: np.ndarray | slice) -> "Moments":
        return Moments(self.before[chosen], self.after[chosen], self.since_s[chosen], self.until_s[chosen])

    def poses(self, pose: np.ndarray, robot: Robot) -> np.ndarray:
        """Return the poses (Q, 3) at these moments, given that of each row (R, 3); NaN where nobody knows.

        Between two known poses that are no further apart than the robot's longest gap, the straight line between them
        counts; otherwise the nearest known pose, if it is within half a period.
        """
        start, end = pose[self.before], pose[self.after]
        since_s = np.where(np.isnan(start).any(axis=-1), np.inf, self.since_s)
        until_s = np.where(np.isnan(end).any(axis=-1), np.inf, self.until_s)
        between = at_most(since_s + until_s, robot.longest_gap_s)
        share = np.divide(since_s, since_s + until_s, out=np.zeros_like(since_s), where=between)
        way = end - start
        way[..., 2] = wrap_angle(way[..., 2])
        line = start + share[..., None] * way
        line[..., 2] = wrap_angle(line[..., 2])
        nearest = np.where((until_s < since_s)[..., None], end, start)
        near = at_most(np.minimum(since_s, until_s), robot.period_s / 2)
        return np.where(between[..., None], line, np.where(near[..., None], nearest, np.nan))


def neighbours_at(
    row: np.ndarray, track: np.ndarray, time_s: np.ndarray, pose: np.ndarray, others: np.ndarray, robot: Robot
) -> np.ndarray:
    """Return (P, K, 3) what the vehicles see of the others at their rows (P,), as in `Transitions.neighbours`.

    Args:
        row: (P,) the rows asked for.
        track: (R,) of each row, ascending.
        time_s: (R,) of each row, ascending within a track.
        pose: (R, 3) of each row, NaN where it is unknown or not to be believed.
        others: (T, K) the other tracks in the run of each track, as `others_of` gives them.
        robot: says how far apart in time two poses may be.
    """
    neighbours = np.full((len(row), others.shape[1], 3), np.nan)
    for place, other in enumerate(others.T):
        moments = Moments.of(track, time_s, row, other[track[row]])
        neighbours[:, place] = displacement_between(pose[row], moments.poses(pose, robot))
    return neighbours
