"""What of a recording it is judged by, taken as its rows pass by: an even part of them, so that memory stays bounded.

While a recording has no more rows than are kept, nothing is left out, and it is judged by all that it holds.
"""

from collections.abc import Sequence

import numpy as np

from swarmtwin.recordings.even_sample import EvenSample
from swarmtwin.recordings.observed_motion import ObservedMotion
from swarmtwin.recordings.recording import Track
from swarmtwin.recordings.rows import Rows, at_most
from swarmtwin.robot import Robot


class SampledRows:
    """Times between rows, positions, and pairs of successive rows with their commands, of tracks that passed by.

    Attributes:
        robot: whose they are.
        farthest_row: of each pair, the commands of so many rows before and after it are kept as well.
    """

    def __init__(
        self, robot: Robot, *, farthest_row: int = 3, most_pairs: int = 250_000, most_rows: int = 1_000_000
    ) -> None:
        """Begin with nothing.

        Args:
            robot: whose rows they are.
            farthest_row: see above.
            most_pairs: pairs to keep, with commands and poses.
            most_rows: times between rows to keep, and positions.
        """
        self.robot = robot
        self.farthest_row = farthest_row
        self._between_s, self._position = EvenSample(most_rows), EvenSample(most_rows)
        self._pairs = EvenSample(most_pairs)
        self._vehicles: dict[str, int] = {}

    def add(self, tracks: Sequence[Track]) -> None:
        """Let whole tracks pass by, in their order."""
        if not tracks:
            return
        rows = Rows.of(tracks)
        start = rows.starts()
        duration_s = rows.time_s[start + 1] - rows.time_s[start]
        self._between_s.add(len(start), duration_s[self._between_s.due(len(start))])
        position = rows.pose[~np.isnan(rows.pose).any(axis=1), :2]
        self._position.add(len(position), position[self._position.due(len(position))])
        usual = at_most(self.robot.period_s / 2, duration_s) & at_most(duration_s, self.robot.longest_gap_s)
        seen = ~np.isnan(rows.pose[start] + rows.pose[start + 1]).any(axis=1)
        self._add_pairs(tracks, rows, start[usual & seen])

    def _add_pairs(self, tracks: Sequence[Track], rows: Rows, start: np.ndarray) -> None:
        number = [self._vehicles.setdefault(track.vehicle, len(self._vehicles)) for track in tracks]
        count, start = len(start), start[self._pairs.due(len(start))]
        commands = []
        for offset in range(-self.farthest_row, self.farthest_row + 1):
            other = np.clip(start + offset, 0, len(rows) - 1)
            known = (rows.track[other] == rows.track[start]) & (other == start + offset)
            commands.append(np.where(known[:, None], rows.command[other], np.nan))
        vehicle = np.array(number)[rows.track[start]]
        self._pairs.add(count, np.stack(commands, axis=1), rows.pose[start], rows.pose[start + 1], vehicle)

    @property
    def pairs(self) -> int:
        """How many pairs of successive rows have passed by."""
        return self._between_s.seen

    @property
    def vehicles(self) -> tuple[str, ...]:
        """Ids of the vehicles that occur, sorted."""
        return tuple(sorted(self._vehicles))

    def between_s(self) -> np.ndarray:
        """Return the times (S,) between successive rows of a track."""
        return self._between_s.columns()[0]

    def position(self) -> np.ndarray:
        """Return the positions (S, 2) x_mm, y_mm of poses that are known."""
        return self._position.columns()[0]

    def motion(self, vehicle: str | None = None, most_pairs: int = 20_000) -> ObservedMotion:
        """Return pairs about a control period apart, of many a part that is spread evenly; or those of one vehicle."""
        commands, start, end, number = self._pairs.columns()
        chosen = np.arange(len(start)) if vehicle is None else np.flatnonzero(number == self._vehicles[vehicle])
        chosen = chosen[:: max(1, -(-len(chosen) // most_pairs))]
        return ObservedMotion(self.robot, np.swapaxes(commands[chosen], 0, 1), start[chosen], end[chosen])
