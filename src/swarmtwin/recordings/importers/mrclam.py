"""Importer of the UTIAS Multi-Robot Cooperative Localization and Mapping data sets (MR.CLAM).

Leung, Halpern, Barfoot and Liu, IJRR 30(8):969-974, 2011: five iRobot Create in one arena for some 15 minutes. Files of
robot N, text with comment lines: `RobotN_Odometry.dat` (time in s, velocity commands v in m/s and omega in rad/s) and
`RobotN_Groundtruth.dat` (time in s, x and y in m, heading in rad, by motion capture).
"""

import datetime
import itertools
import logging
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import numpy as np

from swarmtwin.errors import UserError, near_miss
from swarmtwin.recordings.importer import ImporterConfig
from swarmtwin.recordings.recording import Header, Sent, Track, fault
from swarmtwin.recordings.resampling import interpolate_poses, mean_held
from swarmtwin.robot import Positive, Robot

logger = logging.getLogger(__name__)


@dataclass(frozen=True)
class _Stream:
    """Samples of one file, in order of time: time_s (S,), seconds since 1970, and values (S, k)."""

    time_s: np.ndarray
    values: np.ndarray


def _session(folder: Path, poses: Mapping[str, _Stream]) -> tuple[float, float]:
    """Return when the first pose and the last were measured, in s since 1970, at most a day apart."""
    start_s = min(float(stream.time_s[0]) for stream in poses.values())
    end_s = max(float(stream.time_s[-1]) for stream in poses.values())
    days = (end_s - start_s) / 86_400
    if days > 1:
        apart = f"the robots' poses were measured up to {days:.1f} days apart"
        raise fault(folder, apart, "use files of one and the same data set")
    return start_s, end_s


def _pose_file(folder: Path, vehicle: str) -> Path:
    return folder / f"Robot{vehicle}_Groundtruth.dat"


def _command_file(folder: Path, vehicle: str) -> Path:
    return folder / f"Robot{vehicle}_Odometry.dat"


def _chosen_vehicles(folder: Path, vehicles: Sequence[str] | None) -> list[str]:
    if not folder.is_dir():
        raise UserError(f"no MR.CLAM folder {folder}: name the one that holds Robot1_Groundtruth.dat")
    names = (re.fullmatch(r"Robot(\d+)_(?:Groundtruth|Odometry)\.dat", file.name) for file in folder.iterdir())
    found = sorted({name[1] for name in names if name}, key=int)
    if not found:
        raise UserError(f"{folder} holds no MR.CLAM files: name the folder that holds Robot1_Groundtruth.dat")
    for vehicle in vehicles or ():
        if vehicle not in found:
            raise UserError(f"{folder} holds no robot {vehicle!r}: {near_miss(vehicle, found)}")
    chosen = found if vehicles is None else list(dict.fromkeys(vehicles))
    for file in itertools.chain.from_iterable((_pose_file(folder, v), _command_file(folder, v)) for v in chosen):
        if not file.is_file():
            raise UserError(f"{file} is missing: a robot needs its Groundtruth and its Odometry file")
    return chosen


def _read_stream(file: Path, fields: Sequence[str]) -> _Stream:
    """Read one file: comments skipped, rows sorted by time, the later of two rows at one time left out."""
    content = file.read_bytes()
    complete = content[: content.rfind(b"\n") + 1]
    if len(complete) < len(content):
        logger.warning("%s: its last row is cut off and left out", file)
    try:
        lines = complete.decode().splitlines()
        filled = [number for number, line in enumerate(lines, start=1) if line.partition("#")[0].strip()]
        if not filled:
            raise fault(file, "there are no rows", "copy it again from the data set")
        values = np.loadtxt([lines[number - 1] for number in filled], ndmin=2)
    except ValueError:
        raise _damaged_row(file, complete, fields) from None
    if values.shape[1] != len(fields) or not np.isfinite(values).all():
        raise _damaged_row(file, complete, fields)
    _check_times(file, values[:, 0], filled)
    time_s, first = np.unique(values[:, 0], return_index=True)
    return _Stream(time_s, values[first, 1:])


def _check_times(file: Path, time_s: np.ndarray, row_numbers: Sequence[int]) -> None:
    """Refuse times (S,) that no data set has, or that lie far from most of the file's."""
    days_from_most = np.abs(time_s - np.median(time_s)) / 86_400
    year_2100_s = 4_102_444_800
    strays = np.flatnonzero((np.abs(time_s) > year_2100_s) | (days_from_most > 1))
    if len(strays):
        what = f"time {time_s[strays[0]]:g} s is more than a day from most others, or beyond the year 2100"
        raise fault(file, what, "copy the file again from the data set", row=row_numbers[strays[0]], column="time")


def _damaged_row(file: Path, content: bytes, fields: Sequence[str]) -> UserError:
    """Find the first row that does not hold one finite number for each of `fields`."""
    remedy = f"rows hold {', '.join(fields)}; copy the file again from the data set"
    for number, line in enumerate(content.splitlines(), start=1):
        cells = line.decode(errors="replace").partition("#")[0].split()
        if cells and len(cells) != len(fields):
            return fault(file, f"{len(cells)} numbers instead of {len(fields)}", remedy, row=number)
        for field, cell in zip(fields, cells, strict=False):
            if not _is_finite(cell):
                return fault(file, f"{cell!r} is not a number", remedy, row=number, column=field)
    return fault(file, "the file is no text", remedy)


def _is_finite(cell: str) -> bool:
    try:
        return bool(np.isfinite(float(cell)))
    except ValueError:
        return False


def _resample(
    config: "Config", vehicle: str, time_s: np.ndarray, session_s: float, poses: _Stream, commands: _Stream
) -> Track:
    """Return one vehicle's rows at the ticks `time_s` (T,), without those before and after its drive."""
    pose = interpolate_poses(poses.time_s - session_s, poses.values, time_s, config.longest_pose_gap_s)
    pose[:, :2] *= 1000
    command = np.full((len(time_s), 2), np.nan)
    held = commands.values * [1000, 1]
    command[:-1] = mean_held(commands.time_s - session_s, held, time_s, config.longest_hold_s)
    seen, commanded = ~np.isnan(pose[:, 0]), ~np.isnan(command[:, 0])
    starts, ends = np.flatnonzero(seen & commanded), np.flatnonzero(seen[1:] & commanded[:-1]) + 1
    rows = np.arange(starts[0], ends[-1] + 1) if len(starts) and len(ends) else np.arange(0)
    return Track("", vehicle, time_s[rows], command[rows], pose[rows])


def _cut(track: Track, time_s: np.ndarray, steps: int) -> list[Track]:
    """Cut a track into runs of `steps` periods of the common ticks `time_s`; neighbours share the pose between them."""
    runs = []
    for number, first in enumerate(range(0, len(time_s) - 1, steps), start=1):
        last = min(first + steps, len(time_s) - 1)
        rows = np.flatnonzero((track.time_s >= time_s[first]) & (track.time_s <= time_s[last]))
        if len(rows) < 2:
            continue
        command = track.command[rows].copy()
        command[-1] = np.nan
        runs.append(Track(f"run_{number:04d}", track.vehicle, track.time_s[rows], command, track.pose[rows]))
    return runs


class Config(ImporterConfig):
    """`conf/source/mrclam.yaml`.

    Attributes:
        longest_pose_gap_s: over which poses are interpolated; the data sets have one every 15 ms.
        longest_hold_s: for which a command stands; the drivers log none for up to 1 s while it does not change.
    """

    name: Literal["mrclam"] = "mrclam"
    longest_pose_gap_s: Positive = 0.1
    longest_hold_s: Positive = 1.1

    def read(
        self, folder: Path, robot: Robot, vehicles: Sequence[str] | None = None, run_s: float = 30.0
    ) -> tuple[Header, list[Track]]:
        """Bring a MR.CLAM data set to the robot's period, cut into runs of `run_s`.

        All vehicles share one clock and its ticks; times count from the first pose of the chosen vehicles. A row holds
        the pose at its tick, interpolated, and the mean command until the next tick; where either is unknown its cells
        are empty. A run ends with the pose that the next one begins with.

        Args:
            folder: where the files are.
            robot: its command must be v_mm_s, omega_rad_s.
            vehicles: the robots' numbers as text; None for all there are.
            run_s: length of a run.

        Raises:
            UserError: files are missing or damaged, or hold no drive.
        """
        if robot.command_columns != ("v_mm_s", "omega_rad_s"):
            raise UserError(f"MR.CLAM is driven by v_mm_s, omega_rad_s, robot {robot.name!r} is not: add robot=create")
        chosen = _chosen_vehicles(folder, vehicles)
        poses = {
            vehicle: _read_stream(_pose_file(folder, vehicle), ("time", "x", "y", "heading")) for vehicle in chosen
        }
        commands = {vehicle: _read_stream(_command_file(folder, vehicle), ("time", "v", "omega")) for vehicle in chosen}
        session_s, end_s = _session(folder, poses)
        ticks = int(np.ceil((end_s - session_s) / robot.period_s)) + 1
        time_s = np.arange(ticks) * robot.period_s
        tracks = []
        for vehicle in chosen:
            track = _resample(self, vehicle, time_s, session_s, poses[vehicle], commands[vehicle])
            if not len(track):
                what = f"robot {vehicle} has no command while its pose is known"
                raise fault(_command_file(folder, vehicle), what, "use files of one and the same data set")
            tracks += _cut(track, time_s, max(1, round(run_s / robot.period_s)))
        header = Header(
            robot=robot.name,
            period_s=robot.period_s,
            arena_mm=robot.arena_mm,
            source=f"MR.CLAM, {folder.resolve().name} (Leung et al., IJRR 2011)",
            vehicles=tuple(chosen),
            started_at=datetime.datetime.fromtimestamp(session_s, datetime.UTC).isoformat(timespec="milliseconds"),
        )
        return header, sorted(tracks, key=lambda track: (track.run, track.vehicle))

    def sent(self, folder: Path, robot: Robot, vehicles: Sequence[str] | None = None) -> Sent:
        """Return the velocity commands as they were logged, on the clock of `read`.

        Raises:
            UserError: files are missing or damaged.
        """
        chosen = _chosen_vehicles(folder, vehicles)
        poses = {
            vehicle: _read_stream(_pose_file(folder, vehicle), ("time", "x", "y", "heading")) for vehicle in chosen
        }
        session_s, _ = _session(folder, poses)
        streams = {vehicle: _read_stream(_command_file(folder, vehicle), ("time", "v", "omega")) for vehicle in chosen}
        return {vehicle: (one.time_s - session_s, one.values * [1000, 1]) for vehicle, one in streams.items()}
