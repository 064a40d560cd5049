"""`swarmtwin track`: a video and the commands that were sent become a recording."""

import logging
from collections.abc import Mapping
from pathlib import Path
from typing import Annotated, Any

import numpy as np
import pandas as pd
from pydantic import Field
from rich.console import Console
from rich.progress import Progress, SpinnerColumn, TextColumn, TimeElapsedColumn
from rich.table import Table

from swarmtwin.deploy.camera.opening import open_camera
from swarmtwin.deploy.tracking.calibration import Calibration
from swarmtwin.deploy.tracking.calibration_fit import MeasuredByHand, loaded_or_fitted
from swarmtwin.deploy.tracking.calibration_pictures import take_pictures
from swarmtwin.deploy.tracking.tracked_pictures import TrackedPictures, track_all
from swarmtwin.deploy.tracking.tracker import Tracker, TrackerSettings
from swarmtwin.errors import UserError
from swarmtwin.files import new_folder
from swarmtwin.recordings.reading import read_recording
from swarmtwin.recordings.recording import Header, Recording
from swarmtwin.recordings.sent_commands import read_sent_commands
from swarmtwin.recordings.synchronising import cut_into_runs, synchronised
from swarmtwin.recordings.writing import FileFormat, write_recording
from swarmtwin.robot import POSE_COLUMNS, Positive, Robot, StrictModel
from swarmtwin.transitions import Counts, from_recording

log = logging.getLogger(__name__)


class Options(StrictModel):
    """Options of `swarmtwin track`; their defaults stand in conf/track.yaml."""

    robot: Robot
    video: str
    calibration: Path | None
    camera_height_mm: Positive | None
    camera_above_mm: tuple[float, float] | None
    commands: Path
    video_began_s: float
    longest_gap_s: Positive
    run_s: Annotated[float, Field(gt=0, le=86_400.0)]
    format: FileFormat | None
    output: Path
    overwrite: bool


def run(options: Options) -> dict[str, Any]:
    """Track, save the recording with all poses beside it, show what was seen, and return how much.

    Raises:
        UserError: the video, the calibration or the commands are missing, damaged or do not fit each other.
    """
    robot = options.robot
    if options.run_s < 2 * robot.period_s:
        raise UserError(f"run_s={options.run_s:g} is too short: give at least two periods, {2 * robot.period_s:g}")
    sent = read_sent_commands(options.commands, robot)
    calibration = _calibration(options)
    config = options.model_dump(mode="json")
    with new_folder(options.output, "track", config, options.overwrite, inputs=_folders(options)) as folder:
        tracked = _track(options.video, calibration, robot, tuple(sent))
        poses = tracked.poses(options.video_began_s)
        _check_seen(tracked, poses, sent, options)
        rows = synchronised(poses, sent, "run", options.longest_gap_s)
        header = Header(
            robot=robot.name,
            period_s=robot.period_s,
            arena_mm=calibration.arena_mm,
            source=f"{options.video}, tracked",
            vehicles=tuple(sent),
        )
        write_recording(folder, robot, header, cut_into_runs(rows, options.run_s), options.format)
        _pose_table(poses).to_parquet(folder / "poses.parquet", index=False)
        calibration.save(folder / "calibration.yaml")
        recording = read_recording(folder, robot)
        _, counts = from_recording(recording)
    Console().print(_summary(options.output, tracked, recording, counts))
    return {"pictures": len(tracked.sightings), "transitions": counts.kept, "output": str(options.output)}


def _calibration(options: Options) -> Calibration:
    by_hand = MeasuredByHand(options.camera_height_mm, options.camera_above_mm)
    return loaded_or_fitted(options.calibration, lambda: _pictures(options.video), options.robot, by_hand)


def _pictures(video: str) -> list[np.ndarray]:
    camera = open_camera(video)
    try:
        return take_pictures(camera)
    finally:
        camera.close()


def _folders(options: Options) -> list[Path]:
    video = Path(options.video)
    return [video] if video.is_dir() else []


def _track(video: str, calibration: Calibration, robot: Robot, vehicles: tuple[str, ...]) -> TrackedPictures:
    """Look at all pictures of a source, the first of which must fit the calibration."""
    camera = open_camera(video)
    if camera.is_live:
        camera.close()
        raise UserError(f"video={video} is live: give a video file or a folder of pictures, which end")
    camera.close()
    tracker = Tracker(calibration, robot, vehicles, TrackerSettings(whole_every=1))
    first = open_camera(video)
    try:
        frame = first.next_frame()
        if frame is None:
            raise UserError(f"video={video} holds no pictures: give another")
        tracker.check(frame.image)
    finally:
        first.close()
    camera = open_camera(video)
    columns = SpinnerColumn(), TextColumn("{task.completed} pictures"), TimeElapsedColumn()
    try:
        with Progress(*columns, transient=True) as progress:
            task = progress.add_task("", total=None)
            return track_all(camera, tracker, vehicles, lambda: progress.advance(task))
    finally:
        camera.close()


def _check_seen(tracked: TrackedPictures, poses: dict[str, Any], sent: Mapping[str, Any], options: Options) -> None:
    """Warn of vehicles that are never seen, of markers that belong to nobody and of doubts; refuse if nothing fits.

    Raises:
        UserError: no vehicle is seen, or none while it is commanded.
    """
    if not poses:
        raise UserError(
            f"none of the vehicles {', '.join(sent)} is seen in {options.video}: look whether their markers are"
        )
    for vehicle in tracked.vehicles:
        if vehicle not in poses:
            log.warning("vehicle %s is never seen: its commands have no poses", vehicle)
        for reason, count in tracked.doubts(vehicle).items():
            log.warning("vehicle %s is not believed on %d pictures: %s", vehicle, count, reason)
    for number, count in tracked.strangers.items():
        if count > 2:
            log.warning("marker %d is seen on %d pictures and belongs to no vehicle that is commanded", number, count)
    seen_s = [(times[0], times[-1]) for times, _ in poses.values()]
    sent_s = [(times[0], times[-1]) for times, _ in sent.values()]
    first, last = min(one for one, _ in seen_s), max(one for _, one in seen_s)
    if max(one for _, one in sent_s) < first or min(one for one, _ in sent_s) > last:
        raise UserError(
            f"{options.commands}: commands begin at {min(one for one, _ in sent_s):g} s, and vehicles are seen from "
            f"{first:g} to {last:g} s: give video_began_s=..., the time of the first picture on the commands' clock"
        )


def _pose_table(poses: dict[str, Any]) -> pd.DataFrame:
    rows = [(time, vehicle, *pose) for vehicle, seen in poses.items() for time, pose in zip(*seen, strict=True)]
    return pd.DataFrame(rows, columns=["time_s", "vehicle", *POSE_COLUMNS]).sort_values("time_s", kind="stable")


def _summary(output: Path, tracked: TrackedPictures, recording: Recording, counts: Counts) -> Table:
    pictures = len(tracked.sightings)
    title = f"{output}: {pictures} pictures, {len(recording.runs)} runs, {counts.kept} usable transitions"
    table = Table("vehicle", "seen", "not seen", "doubted", "rows", title=title)
    for vehicle in tracked.vehicles:
        seen, doubted = tracked.seen(vehicle), sum(tracked.doubts(vehicle).values())
        rows = sum(len(track) for track in recording.tracks if track.vehicle == vehicle)
        table.add_row(vehicle, str(seen), str(pictures - seen - doubted), str(doubted), str(rows))
    for column in table.columns[1:]:
        column.justify = "right"
    return table
