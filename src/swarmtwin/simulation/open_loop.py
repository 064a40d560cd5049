"""Open loop: a whole run predicted from its first pose and its commands alone (paper, section 4.3, figure 13).

A simulation that looks at velocity begins with the first measured one, at the second pose: a run may begin in motion.
"""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
import torch

from swarmtwin.errors import UserError
from swarmtwin.geometry import displacement_between, log_map
from swarmtwin.recordings.recording import Track
from swarmtwin.recordings.rows import at_most
from swarmtwin.simulation.mechanism import true_neighbours
from swarmtwin.simulation.simulation import Simulation
from swarmtwin.simulation.state import State
from swarmtwin.transitions.neighbours import Moments, others_of


class OpenLoop(NamedTuple):
    """One vehicle's run, predicted.

    Attributes:
        track: what was measured.
        predicted: (T, 3) x_mm, y_mm, heading_rad: the measured pose at the row that it is predicted from, the first
            that has one or the one after, and predictions after it; NaN before it, and beyond the first gap or missing
            command.
        rmse_mm: over the predicted rows whose pose was measured, the first one left out; NaN if there are none.
    """

    track: Track
    predicted: np.ndarray
    rmse_mm: float


class OpenLoopFigure(NamedTuple):
    """Root mean square errors, mean ± standard deviation over runs."""

    rmse_mm: float
    rmse_sd_mm: float
    runs: int


def rmse_mm(predicted: np.ndarray, measured: np.ndarray) -> float:
    """Return the root mean square distance in mm between poses (T, 3), over the rows known in both."""
    squared = ((predicted[:, :2] - measured[:, :2]) ** 2).sum(axis=1)
    known = np.isfinite(squared)
    return float(np.sqrt(squared[known].mean())) if known.any() else float("nan")


def open_loop(simulation: Simulation, tracks: Sequence[Track]) -> list[OpenLoop]:
    """Predict whole runs, all at once, by stepping the simulation from each run's first known pose, or second one.

    A run is predicted until a command is missing or the next row is further away than the robot's `longest_gap_s`. A
    simulation that looks at neighbours sees those tracks of the same run that are among `tracks` where they are
    predicted to be, and before and after their prediction where they were measured.
    """
    if not tracks:
        return []
    parts = [_predictable_rows(track, simulation.robot.longest_gap_s) for track in tracks]
    if "velocity" in simulation.inputs:
        parts = [_from_second_pose(track, part) for track, part in zip(tracks, parts, strict=True)]
    rows = _Rows.of(tracks, parts)
    moments = rows.moments() if "neighbours" in simulation.inputs else None
    pose = np.concatenate([track.pose for track in tracks])
    state = _started(simulation, rows, pose)
    for now in rows.turns(in_order_of_time=moments is not None):
        track = torch.as_tensor(rows.track[now])
        neighbours = None
        if moments is not None:
            others = moments[now].poses(pose, simulation.robot)
            own = torch.as_tensor(pose[now])
            neighbours = displacement_between(own[:, None], torch.as_tensor(others))
            neighbours = true_neighbours(own, neighbours, simulation.from_measured)[:, None]
        duration_s = torch.as_tensor(rows.time_s[now + 1] - rows.time_s[now])[:, None]
        moved = simulation.step(
            state[track], torch.as_tensor(rows.command[now])[:, None], duration_s, neighbours=neighbours
        )
        state = state.with_worlds(track, moved)
        pose[now + 1] = simulation.observe(moved)[:, 0].numpy()
    poses = np.split(pose, np.cumsum([len(track) for track in tracks])[:-1])
    return [_compared(*run) for run in zip(tracks, parts, poses, strict=True)]


def _started(simulation: Simulation, rows: "_Rows", pose: np.ndarray) -> State:
    """Put one vehicle a track, each in a world of its own, where its prediction begins, after the command before it.

    It is at rest; where the simulation looks at velocity, it moves as in the period before, if that was measured.
    """
    first = rows.first_step()
    measured = torch.as_tensor(np.nan_to_num(pose[first]))
    elapsed_s = torch.as_tensor(rows.time_s[first])[:, None]
    true = simulation.from_measured(measured)[:, None]
    before = np.maximum(first - 1, 0)
    lasted_s = rows.time_s[first] - rows.time_s[before]
    known = (rows.track[before] == rows.track[first]) & (before < first) & (lasted_s <= simulation.robot.longest_gap_s)
    previous = torch.as_tensor(np.where(known[:, None], rows.command[before], np.nan))[:, None]
    if "velocity" not in simulation.inputs:
        return simulation.start(true, elapsed_s, previous_command=previous)
    moved = log_map(displacement_between(pose[before], pose[first]))
    velocity = np.where(known[:, None], np.nan_to_num(moved / np.where(known, lasted_s, 1.0)[:, None]), 0.0)
    return simulation.start(true, elapsed_s, velocity=torch.as_tensor(velocity)[:, None], previous_command=previous)


def summary(runs: Sequence[OpenLoop]) -> OpenLoopFigure:
    """Summarise over the runs that could be predicted.

    Raises:
        UserError: there are none.
    """
    errors = np.array([run.rmse_mm for run in runs if np.isfinite(run.rmse_mm)])
    if not len(errors):
        raise UserError("no run can be predicted open loop: poses or commands are missing from the start")
    return OpenLoopFigure(float(errors.mean()), float(errors.std()), len(errors))


class _Rows(NamedTuple):
    """The R rows of T tracks, one track after the other.

    Attributes:
        runs: the run of each track.
        track: (R,) index of the track.
        time_s: (R,).
        command: (R, m).
        steps: (S,) the rows from which a step is predicted.
        number: (S,) counts the steps of each track, from 0.
    """

    runs: tuple[str, ...]
    track: np.ndarray
    time_s: np.ndarray
    command: np.ndarray
    steps: np.ndarray
    number: np.ndarray

    @classmethod
    def of(cls, tracks: Sequence[Track], parts: Sequence[range]) -> "_Rows":
        lengths = [len(track) for track in tracks]
        first = np.cumsum([0, *lengths])
        steps = [np.arange(part.start, part.stop) + row for part, row in zip(parts, first, strict=False)]
        return cls(
            runs=tuple(track.run for track in tracks),
            track=np.repeat(np.arange(len(tracks)), lengths),
            time_s=np.concatenate([track.time_s for track in tracks]),
            command=np.concatenate([track.command for track in tracks]),
            steps=np.concatenate(steps),
            number=np.concatenate([np.arange(len(part)) for part in parts]),
        )

    def first_step(self) -> np.ndarray:
        """Return (T,) the row that each track is predicted from; its first one where it is not predicted."""
        first = np.searchsorted(self.track, np.arange(len(self.runs)))
        begins = self.number == 0
        first[self.track[self.steps[begins]]] = self.steps[begins]
        return first

    def turns(self, in_order_of_time: bool) -> list[np.ndarray]:
        """Return the rows to predict from, one batch after the other, at most one row of each track in a batch.

        In order of time, all that begins earlier in a run is in an earlier batch, and what begins at one moment is in
        the same; otherwise the n-th batch has the n-th step of every track.
        """
        turn = self._earlier_moments() if in_order_of_time else self.number
        order = np.argsort(turn, kind="stable")
        return np.split(self.steps[order], np.flatnonzero(np.diff(turn[order])) + 1) if len(order) else []

    def _earlier_moments(self) -> np.ndarray:
        """Return (S,) how many moments, at which steps begin, come before each step in its run."""
        names = {name: index for index, name in enumerate(dict.fromkeys(self.runs))}
        run = np.array([names[name] for name in self.runs])[self.track[self.steps]]
        moments, moment = np.unique(np.column_stack([run, self.time_s[self.steps]]), axis=0, return_inverse=True)
        before: np.ndarray = moment - np.searchsorted(moments[:, 0], run)
        return before

    def moments(self) -> Moments:
        """Return (R, K) where in the others' tracks the time of each row lies."""
        return Moments.of(
            self.track, self.time_s, np.arange(len(self.track))[:, None], others_of(self.runs)[self.track]
        )


def _predictable_rows(track: Track, longest_gap_s: float) -> range:
    """Return the rows from which a step is predicted: from the first known pose to the first obstacle."""
    known = np.isfinite(track.pose).all(axis=1)
    if not known.any():
        return range(0)
    start = int(known.argmax())
    passable = np.isfinite(track.command[:-1]).all(axis=1) & at_most(np.diff(track.time_s), longest_gap_s)
    obstacles = np.flatnonzero(~passable[start:])
    return range(start, start + int(obstacles[0]) if len(obstacles) else len(track) - 1)


def _from_second_pose(track: Track, part: range) -> range:
    """Return the same rows without the first one, if a pose was measured at its end."""
    second = part.start + 1
    return range(second, part.stop) if second in part and np.isfinite(track.pose[second]).all() else part


def _compared(track: Track, part: range, pose: np.ndarray) -> OpenLoop:
    predicted = np.full((len(track), 3), np.nan)
    if not part:
        return OpenLoop(track, predicted, float("nan"))
    predicted[part.start : part.stop + 1] = pose[part.start : part.stop + 1]
    after = slice(part.start + 1, part.stop + 1)
    return OpenLoop(track, predicted, rmse_mm(predicted[after], track.pose[after]))
