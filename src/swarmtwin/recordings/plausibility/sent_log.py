"""The log of the commands that were sent against the commands of the rows: one clock, and the same commands."""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np

from swarmtwin.recordings.plausibility.doubt import Doubt, Limits
from swarmtwin.recordings.recording import SENT_FILE, Sent, Track
from swarmtwin.recordings.resampling import mean_held
from swarmtwin.robot import Robot


@dataclass
class _Compared:
    """Sums over the rows of a vehicle, of commands as shares of the robot's ranges (m,).

    Attributes:
        rows: that have a command.
        logged: rows in whose whole period the log has a command in force.
        command: sum of the commands of these.
        square: likewise of their squares.
        difference: likewise of the squares of what they differ from the log's mean command in that period.
    """

    rows: int
    logged: int
    command: np.ndarray
    square: np.ndarray
    difference: np.ndarray

    def disagreement(self) -> float:
        """Return the mean square difference from the log over the variance of the commands; 0 of constant ones."""
        mean = self.command / self.logged
        variance = float((self.square / self.logged - mean**2).sum())
        return float((self.difference / self.logged).sum()) / variance if variance > 1e-6 else 0.0


class SentLog:
    """Compares each row's command with the mean of what the log says was in force until the next row.

    Rows pass by and are not kept.
    """

    def __init__(self, robot: Robot, sent: Sent) -> None:
        self._robot, self._sent = robot, sent
        self._compared: dict[str, _Compared] = {}
        self._unknown: set[str] = set()

    def add(self, tracks: Sequence[Track]) -> None:
        """Let whole tracks pass by."""
        size = self._robot.command_high - self._robot.command_low
        for track in tracks:
            if track.vehicle not in self._sent:
                self._unknown.add(track.vehicle)
                continue
            logged = mean_held(*self._sent[track.vehicle], track.time_s, 2 * self._robot.longest_gap_s) / size
            command = track.command[:-1] / size
            given = np.isfinite(command).all(axis=1)
            known = given & np.isfinite(logged).all(axis=1)
            empty = (np.zeros(len(size)) for _ in range(3))
            so_far = self._compared.setdefault(track.vehicle, _Compared(0, 0, *empty))
            so_far.rows += int(given.sum())
            so_far.logged += int(known.sum())
            so_far.command += command[known].sum(axis=0)
            so_far.square += (command[known] ** 2).sum(axis=0)
            so_far.difference += ((command[known] - logged[known]) ** 2).sum(axis=0)

    def doubts(self, limits: Limits) -> Iterator[Doubt]:
        """Say of which vehicles the log has nothing, or little, or other commands than the rows."""
        if self._unknown:
            which, knows = (", ".join(map(repr, sorted(some)[:5])) for some in (self._unknown, self._sent))
            said = f"{SENT_FILE} has no commands of vehicle {which}, but of {knows}"
            yield Doubt("clock", False, f"{said}: the rows' commands are taken to be sent as each period begins")
        remedy = f"bring the times in {SENT_FILE} to the clock of the rows, or take the file away"
        for vehicle, compared in sorted(self._compared.items()):
            if compared.rows >= limits.fewest_pairs and not compared.logged:
                said = f"{SENT_FILE} has no command of vehicle {vehicle!r} in the time of any of its rows"
                yield Doubt("clock", True, f"{said}: {remedy}")
            elif compared.rows >= limits.fewest_pairs and compared.logged < limits.logged * compared.rows:
                share = f"{compared.logged:,} of {compared.rows:,} rows"
                yield Doubt("clock", False, f"{SENT_FILE} says what was in force in {share} of vehicle {vehicle!r}")
            if compared.logged >= limits.fewest_pairs and compared.disagreement() > limits.log_disagreement:
                said = f"by {SENT_FILE} other commands were in force than the rows of vehicle {vehicle!r} have"
                yield Doubt("clock", True, f"{said}: {remedy}")
