"""Measured transitions as a diagnosis works on them."""

from dataclasses import dataclass, replace
from functools import cached_property
from typing import NamedTuple, Self

import numpy as np
import torch
from scipy.spatial import cKDTree
from torch import Tensor

from swarmtwin.geometry import compose, exp_map, log_map, wrap_angle
from swarmtwin.learning.situation import Situation
from swarmtwin.recordings.blocks import FEWEST_RUNS
from swarmtwin.recordings.recording import Sent, Track
from swarmtwin.recordings.resampling import mean_held
from swarmtwin.simulation.conditions import SessionConditions
from swarmtwin.transitions import Transitions


class SentCommands(NamedTuple):
    """Commands at the times they were sent, for N transitions.

    Attributes:
        sent: by vehicle.
        transitions: N.
        longest_hold_s: a command is taken to hold no longer than this.
    """

    sent: Sent
    transitions: Transitions
    longest_hold_s: float

    @property
    def a_period(self) -> float:
        """How many commands are sent in a period, usually."""
        intervals_s = np.concatenate([np.diff(time_s) for time_s, _ in self.sent.values()])
        return self.transitions.robot.period_s / float(np.median(intervals_s)) if len(intervals_s) else 0.0

    def late(self, late_s: float, places: int = 3) -> list[np.ndarray]:
        """Return the mean commands (N, m) in force in each period, the one before, …, where each acts `late_s` late.

        As recorded where the log does not say.
        """
        transitions = self.transitions
        recorded = (transitions.command, transitions.previous_command, transitions.earlier_command)
        found = [np.array(one, float) for one in recorded[:places]]
        for index, vehicle in enumerate(transitions.vehicles):
            rows = np.flatnonzero(transitions.vehicle == index)
            start_s, period_s = transitions.time_s[rows] - late_s, transitions.robot.period_s
            for place, known in enumerate(found):
                lasted_s = transitions.duration_s[rows] if place == 0 else period_s
                known[rows] = self.in_force(vehicle, start_s - place * period_s, lasted_s, known[rows])
        return found

    def in_force(
        self, vehicle: str, start_s: np.ndarray, lasted_s: np.ndarray | float, recorded: np.ndarray
    ) -> np.ndarray:
        """Return a vehicle's mean commands (K, m) over spans that begin at `start_s` (K,); `recorded` where unknown."""
        if vehicle not in self.sent or not len(start_s):
            return recorded
        edges = np.column_stack([start_s, start_s + lasted_s]).ravel()
        mean = mean_held(*self.sent[vehicle], edges, self.longest_hold_s)[::2]
        return np.where(np.isfinite(mean), mean, recorded)

    def acting_late(self, track: Track, late_s: float) -> Track:
        """Return a track with the commands that are in force in its periods, where each acts `late_s` late."""
        period_s = self.transitions.robot.period_s
        command = self.in_force(track.vehicle, track.time_s - late_s, period_s, track.command)
        return replace(track, command=np.where(np.isfinite(track.command), command, np.nan))


@dataclass(frozen=True)
class MeasuredSession:
    """N measured transitions whose previous command is known, in R runs.

    Attributes:
        transitions: what was measured.
        situation: what simulations look at, float64; the command before the previous one is the previous one where it
            is not known.
        conditions: where and how long the session took place.
        twist: (N, 3) measured twists over one period: forward_mm, left_mm, turn_rad.
        run: (N,) numbers from 0 in order of time: the blocks of every statistic.
        follows: (N,) index of the transition just before, of the same vehicle and run; −1 where there is none.
        sent: the commands as they were sent; None where each is sent at the beginning of its period.
    """

    transitions: Transitions
    situation: Situation
    conditions: SessionConditions
    twist: Tensor
    run: np.ndarray
    follows: np.ndarray
    sent: SentCommands | None = None

    @classmethod
    def of(cls, transitions: Transitions, conditions: SessionConditions, sent: Sent | None = None) -> Self:
        """Take those of the transitions whose previous command is known, and of a robot with momentum the velocity."""
        before = [transitions.previous_command]
        if "velocity" in transitions.robot.situation:
            before.append(transitions.velocity)
        known = transitions.where(np.isfinite(np.column_stack(before)).all(axis=1))
        twist = log_map(torch.as_tensor(known.displacement))
        earlier_command = np.where(np.isfinite(known.earlier_command), known.earlier_command, known.previous_command)
        situation = Situation(
            command=torch.as_tensor(known.command),
            previous_command=torch.as_tensor(known.previous_command),
            earlier_command=torch.as_tensor(earlier_command),
            pose=torch.as_tensor(known.pose),
            velocity=torch.as_tensor(known.velocity),
            elapsed_s=torch.as_tensor(known.time_s),
            duration_s=torch.as_tensor(known.duration_s),
            neighbours=torch.as_tensor(known.neighbours),
        )
        follows = known.just_before()
        _, run = np.unique(known.run, return_inverse=True)
        log = SentCommands(sent, known, 2 * known.robot.longest_gap_s) if sent else None
        return cls(known, situation, conditions, twist, run, follows, log)

    def __len__(self) -> int:
        return len(self.twist)

    @cached_property
    def held(self) -> np.ndarray:
        """(N,) for how many transitions before each its command has held, to a twentieth of its range."""
        robot, alike = self.transitions.robot, 0.05
        command = self.transitions.command / (robot.command_high - robot.command_low)
        held, first = np.zeros(len(self), int), np.arange(len(self))
        for row in np.argsort(self.transitions.time_s, kind="stable"):
            before = self.follows[row]
            if before >= 0 and np.abs(command[row] - command[first[before]]).max() <= alike:
                held[row], first[row] = held[before] + 1, first[before]
        return held

    @property
    def runs(self) -> int:
        """Number of runs."""
        return int(self.run.max()) + 1 if len(self.run) else 0

    def where(self, chosen: np.ndarray) -> "MeasuredSession":
        """Return the transitions chosen by a mask (N,)."""
        return MeasuredSession.of(
            self.transitions.where(chosen), self.conditions, self.sent.sent if self.sent else None
        )

    def folds(self, count: int) -> np.ndarray:
        """Give each transition one of `count` folds, (N,) numbers from 0: whole runs in turn, vehicle by vehicle.

        So each fold has runs of each vehicle that drove so many, in whatever order they drove. With fewer runs there
        are as many folds as runs.
        """
        runs, first, rank = np.unique(self.run, return_index=True, return_inverse=True)
        order = np.lexsort((runs, self.transitions.vehicle[first]))
        folds: np.ndarray = np.argsort(order)[rank] % min(count, len(runs))
        return folds

    def chains(self, longest: int = 64) -> list[np.ndarray]:
        """Return the rows of transitions that follow one another, cut into pieces of at most `longest`."""
        order = np.lexsort((self.transitions.time_s, self.transitions.vehicle, self.run))
        starts = np.flatnonzero((self.follows[order] < 0) | (self.follows[order] != np.roll(order, 1)))
        return [
            chain[begin : begin + longest]
            for chain in np.split(order, starts[1:] if len(starts) and starts[0] == 0 else starts)
            for begin in range(0, len(chain), longest)
        ]

    def spread_over(self, most: int, longest: int = 400) -> np.ndarray:
        """Return a mask (N,) of `most` transitions or hardly more, of runs spread evenly over the session.

        Multiples of the golden ratio choose the runs, which keep step with nothing that recurs every few of them: other
        drives or vehicles in turn, or runs held out. A run of more than `longest` periods counts as several, one after
        the other: the whole session is looked at, however few its runs are. Of the `FEWEST_RUNS` that any conclusion
        takes there may be more transitions.
        """
        if len(self) <= most:
            return np.ones(len(self), bool)
        began_s = np.full(self.runs, np.inf)
        np.minimum.at(began_s, self.run, self.transitions.time_s)
        periods = (self.transitions.time_s - began_s[self.run]) / self.transitions.robot.period_s
        part = np.column_stack([self.run, np.floor(np.round(periods, 6) / longest)])
        _, number, transitions = np.unique(part, axis=0, return_inverse=True, return_counts=True)
        order = np.argsort(np.arange(len(transitions)) * (5**0.5 - 1) / 2 % 1.0)
        enough = 1 + int(np.searchsorted(np.cumsum(transitions[order]), most))
        return np.isin(number.ravel(), order[: max(enough, min(FEWEST_RUNS, self.runs))])

    def under(self, conditions: SessionConditions) -> "MeasuredSession":
        """Return the same transitions under other conditions."""
        return replace(self, conditions=conditions)

    def less(self, errors: np.ndarray) -> "MeasuredSession":
        """Return it with errors (N, 3), in the frame at the end of each period, taken off the displacements.

        Poses, velocities and neighbours stay as they were measured.
        """
        ended = torch.as_tensor(self.transitions.displacement)
        displacement = compose(ended, exp_map(torch.as_tensor(-errors))).numpy()
        transitions = replace(self.transitions, displacement=displacement)
        return MeasuredSession.of(transitions, self.conditions, self.sent.sent if self.sent else None)

    def by_run(self, values: np.ndarray) -> np.ndarray:
        """Sum values (N, ...) over the transitions of each run, (R, ...)."""
        total = np.zeros((self.runs, *values.shape[1:]))
        np.add.at(total, self.run, values)
        return total

    def residual_of(self, twist: Tensor) -> Tensor:
        """Return measured minus simulated twists (N, 3), the angle wrapped."""
        difference = self.twist - twist
        return torch.cat([difference[:, :2], wrap_angle(difference[:, 2:])], dim=-1)

    def covariate_overlap(self, other: "MeasuredSession", neighbours: int) -> np.ndarray:
        """Return (N of other,) how often its transitions are among those nearest to ours, by commands.

        With these weights `other`, the reference, stands for what it would show if it were driven as this session was.
        """
        robot = self.transitions.robot
        size = np.tile(robot.command_high - robot.command_low, 2)

        def commands(of: MeasuredSession) -> np.ndarray:
            return np.concatenate([of.transitions.command, of.transitions.previous_command], axis=1) / size

        count = min(neighbours, len(other))
        _, nearest = cKDTree(commands(other)).query(commands(self), k=np.arange(1, count + 1))
        return np.bincount(nearest.ravel(), minlength=len(other)) / count
