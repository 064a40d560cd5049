"""Recordings become transitions: situation, command and the displacement that followed over one control period."""

from dataclasses import dataclass

import numpy as np

from swarmtwin.robot import Robot

SPLITS = ("train", "validation", "test")


@dataclass(frozen=True)
class Transitions:
    """N transitions as arrays, in order of run, vehicle and time.

    Attributes:
        robot: the robot they were measured on.
        command: (N, m) held over the period, in the robot's units.
        previous_command: (N, m) held over the period before; NaN where there was none (start of a run, after a gap).
        pose: (N, 3) x_mm, y_mm, heading_rad at the start, in the arena's frame.
        displacement: (N, 3) forward_mm, left_mm, turn_rad in the vehicle's frame at the start.
        time_s: (N,) session time at the start.
        duration_s: (N,) measured length of the period.
        run: (N,) index into `runs`.
        vehicle: (N,) index into `vehicles`.
        split: (N,) index into `SPLITS`; all transitions of a run are in the same split.
        runs: names of the runs.
        vehicles: ids of the vehicles.
    """

    robot: Robot
    command: np.ndarray
    previous_command: np.ndarray
    pose: np.ndarray
    displacement: np.ndarray
    time_s: np.ndarray
    duration_s: np.ndarray
    run: np.ndarray
    vehicle: np.ndarray
    split: np.ndarray
    runs: tuple[str, ...]
    vehicles: tuple[str, ...]

    def __len__(self) -> int:
        return len(self.time_s)
