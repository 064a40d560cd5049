"""Open loop: a whole run predicted from its first pose and its commands alone (paper, section 4.3, figure 13)."""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
import torch

from swarmtwin.dynamics.base import Dynamics
from swarmtwin.dynamics.situation import Situation
from swarmtwin.errors import UserError
from swarmtwin.geometry import compose
from swarmtwin.recordings.recording import Track


class OpenLoop(NamedTuple):
    """One vehicle's run, predicted.

    Attributes:
        track: what was measured.
        predicted: (T, 3) x_mm, y_mm, heading_rad: the measured pose at the first row that has one and predictions after
            it; NaN before it, and beyond the first gap or missing command.
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


def open_loop(dynamics: Dynamics, tracks: Sequence[Track]) -> list[OpenLoop]:
    """Predict whole runs, all at once; pose and previous command come from the prediction itself.

    A run is predicted from its first known pose until a command is missing or the next row is further away than the
    robot's `longest_gap_s`.
    """
    rows = [_predictable_rows(track, dynamics.robot.longest_gap_s) for track in tracks]
    drives = _Drives.of(tracks, rows, len(dynamics.robot.command))
    pose = np.full((len(tracks), drives.longest + 1, 3), np.nan)
    pose[:, 0] = drives.first_pose
    for step in range(drives.longest):
        moving = drives.steps > step
        with torch.inference_mode():
            displacement = dynamics(drives.situation(dynamics, moving, step, pose[moving, step]))
        pose[moving, step + 1] = compose(pose[moving, step], displacement.numpy().astype(float))
    return [_compared(*run) for run in zip(tracks, rows, pose, strict=True)]


def summary(runs: Sequence[OpenLoop]) -> OpenLoopFigure:
    """Summarise over the runs that could be predicted.

    Raises:
        UserError: there are none.
    """
    errors = np.array([run.rmse_mm for run in runs if np.isfinite(run.rmse_mm)])
    if not len(errors):
        raise UserError("no run can be predicted open loop: poses or commands are missing from the start")
    return OpenLoopFigure(float(errors.mean()), float(errors.std()), len(errors))


class _Drives(NamedTuple):
    """The predictable parts of R tracks side by side, filled up with NaN after each one's last step.

    Attributes:
        steps: (R,) steps to predict.
        first_pose: (R, 3).
        command: (R, S + 1, m) the command of each step, a row of NaN before the first.
        time_s: (R, S + 1) session time at the start of each step and at the end of the last.
    """

    steps: np.ndarray
    first_pose: np.ndarray
    command: np.ndarray
    time_s: np.ndarray

    @classmethod
    def of(cls, tracks: Sequence[Track], rows: Sequence[range], columns: int) -> "_Drives":
        steps = np.array([len(part) for part in rows], dtype=int)
        longest = steps.max(initial=0)
        first_pose = np.full((len(tracks), 3), np.nan)
        command = np.full((len(tracks), longest + 1, columns), np.nan)
        time_s = np.full((len(tracks), longest + 1), np.nan)
        for index, (track, part) in enumerate(zip(tracks, rows, strict=True)):
            if part:
                first_pose[index] = track.pose[part.start]
                command[index, 1 : len(part) + 1] = track.command[part.start : part.stop]
                time_s[index, : len(part) + 1] = track.time_s[part.start : part.stop + 1]
        return cls(steps, first_pose, command, time_s)

    @property
    def longest(self) -> int:
        return self.command.shape[1] - 1

    def situation(self, dynamics: Dynamics, moving: np.ndarray, step: int, pose: np.ndarray) -> Situation:
        parts = {
            "command": self.command[moving, step + 1],
            "previous_command": self.command[moving, step],
            "pose": pose,
            "elapsed_s": self.time_s[moving, step],
            "duration_s": self.time_s[moving, step + 1] - self.time_s[moving, step],
        }
        return Situation(**{part: torch.as_tensor(parts[part], dtype=torch.float32) for part in dynamics.parts})


def _predictable_rows(track: Track, longest_gap_s: float) -> range:
    """Return the rows from which a step is predicted: from the first known pose to the first obstacle."""
    known = np.isfinite(track.pose).all(axis=1)
    if not known.any():
        return range(0)
    start = int(known.argmax())
    passable = np.isfinite(track.command[:-1]).all(axis=1) & (np.diff(track.time_s) <= longest_gap_s)
    obstacles = np.flatnonzero(~passable[start:])
    return range(start, start + int(obstacles[0]) if len(obstacles) else len(track) - 1)


def _compared(track: Track, rows: range, pose: np.ndarray) -> OpenLoop:
    predicted = np.full((len(track), 3), np.nan)
    if not rows:
        return OpenLoop(track, predicted, float("nan"))
    predicted[rows.start : rows.stop + 1] = pose[: len(rows) + 1]
    after = slice(rows.start + 1, rows.stop + 1)
    return OpenLoop(track, predicted, rmse_mm(predicted[after], track.pose[after]))
