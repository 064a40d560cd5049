"""Whose marker was it? Poses after a teleport are doubted until the track comes back.

A camera that swaps two markers gives both vehicles believable poses again from the next row on, only each the other's:
dropping the two transitions that jump would leave commands paired with another vehicle's motion. So a track is cut at
every teleport into segments, the first segment is trusted, and a later one only if its start can have been reached from
the last trusted pose at a believable speed. A swap that is never undone costs both vehicles the rest of the run.

A vehicle alone in its run can have swapped with nobody: if it jumps away and is not back within
ten periods, somebody has moved it by hand, and the track is trusted again from there.
"""

import numpy as np

from swarmtwin.geometry import displacement_between, wrap_angle
from swarmtwin.recordings.rows import Rows
from swarmtwin.robot import Robot


def teleports(displacement: np.ndarray, periods: np.ndarray, robot: Robot, factor: float = 3.0) -> np.ndarray:
    """Return (P,) whether displacements (P, 3) over `periods` (P,) are far beyond what is believable.

    Far beyond is `factor` times the outlier limit, in proportion to the time but at least for one period.
    """
    limit = factor * robot.displacement_limit * np.maximum(periods, 1.0)[:, None]
    return (np.abs(displacement) > limit).any(axis=1)


def doubtful_rows(rows: Rows, robot: Robot) -> np.ndarray:
    """Return (R,) whether each row's pose may be another vehicle's, or nobody's."""
    doubtful = np.zeros(len(rows), dtype=bool)
    seen = np.flatnonzero(~np.isnan(rows.pose[:, 0]))
    start, end = seen[:-1], seen[1:]
    same_track = rows.track[start] == rows.track[end]
    start, end = start[same_track], end[same_track]
    displacement = displacement_between(rows.pose[start], rows.pose[end])
    periods = (rows.time_s[end] - rows.time_s[start]) / robot.period_s
    jump = teleports(displacement, periods, robot)
    outlier = (np.abs(displacement) > robot.displacement_limit * np.maximum(periods, 1.0)[:, None]).any(axis=1)
    for pair in np.flatnonzero(outlier & ~jump):
        jump[pair] = _lands_on_another(rows, robot, start[pair], end[pair])
    cut_rows = end[jump]
    track_seen, track_cut = rows.track[seen], rows.track[cut_rows]
    for track in np.unique(track_cut):
        of_track = seen[_span(track_seen, track)]
        segments = np.split(of_track, np.searchsorted(of_track, cut_rows[_span(track_cut, track)]))
        for segment in _doubtful_segments(rows, robot, segments):
            doubtful[segment] = True
    return doubtful


def _span(index: np.ndarray, value: int) -> slice:
    """Return where `value` stands in `index`, sorted."""
    return slice(*np.searchsorted(index, [value, value + 1]))


def _lands_on_another(rows: Rows, robot: Robot, start: int, end: int) -> bool:
    """Whether a jump ends where another vehicle of the run can have been, judged by its pose at the jump's start."""
    reach_mm = _reach_mm(robot) * max((rows.time_s[end] - rows.time_s[start]) / robot.period_s, 1.0)
    of_run = _span(rows.run, rows.run[start])
    for track in range(rows.track[of_run.start], rows.track[of_run.stop - 1] + 1):
        other = _span(rows.track, track)
        after = other.start + int(np.searchsorted(rows.time_s[other], rows.time_s[start]))
        nearest = np.arange(max(after - 1, other.start), min(after + 1, other.stop))
        at_the_time = nearest[np.abs(rows.time_s[nearest] - rows.time_s[start]) <= robot.longest_gap_s]
        distance_mm = np.hypot(*(rows.pose[at_the_time, :2] - rows.pose[end, :2]).T)
        if track != rows.track[start] and (distance_mm <= reach_mm).any():
            return True
    return False


def _doubtful_segments(rows: Rows, robot: Robot, segments: list[np.ndarray]) -> list[np.ndarray]:
    """Return those of a track's segments, arrays of rows between teleports, that cannot be trusted."""
    of_run = rows.track[_span(rows.run, rows.run[segments[0][0]])]
    alone = of_run[0] == of_run[-1]
    if len(segments[0]) == 1:
        segments = segments[1:]  # a first pose misread: no transition starts from it anyway
    trusted, doubtful = segments[0][-1], []
    for index, segment in enumerate(segments[1:], start=1):
        moved_by_hand = alone and not _comes_back(rows, robot, trusted, segments, index + 1)
        if moved_by_hand or _reachable(rows, robot, trusted, segment[0]):
            trusted = segment[-1]
        else:
            doubtful.append(segment)
    return doubtful


def _comes_back(
    rows: Rows, robot: Robot, trusted: int, segments: list[np.ndarray], later: int, longest_misread_periods: int = 10
) -> bool:
    """Whether one of the segments from `later` on begins soon and where the last trusted pose allows."""
    latest_s = rows.time_s[trusted] + longest_misread_periods * robot.period_s
    for number in range(later, len(segments)):
        row = segments[number][0]
        if rows.time_s[row] > latest_s:
            return False
        if _reachable(rows, robot, trusted, row):
            return True
    return False


def _reachable(rows: Rows, robot: Robot, start: int, end: int) -> bool:
    """Whether the pose of row `end` can have been reached from that of row `start` at a believable speed."""
    periods = max((rows.time_s[end] - rows.time_s[start]) / robot.period_s, 1.0)
    distance_mm = np.hypot(*(rows.pose[end, :2] - rows.pose[start, :2]))
    turn_rad = np.abs(wrap_angle(rows.pose[end, 2] - rows.pose[start, 2]))
    return bool(distance_mm <= _reach_mm(robot) * periods and turn_rad <= robot.displacement_limit[2] * periods)


def _reach_mm(robot: Robot) -> float:
    """Return the largest believable distance over one period."""
    return float(np.hypot(*robot.displacement_limit[:2]))
