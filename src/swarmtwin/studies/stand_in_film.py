"""A film of a stand-in session by an overhead camera, and the commands that were sent meanwhile."""

from collections.abc import Iterator
from pathlib import Path

import cv2
import numpy as np
import pandas as pd

from swarmtwin.files import write_text
from swarmtwin.recordings.resampling import interpolate_poses
from swarmtwin.standin.overhead_camera import OverheadCamera
from swarmtwin.standin.session import DrivenSession
from swarmtwin.standin.streams import Streams
from swarmtwin.world.rendering.video import write_video


def write_film(folder: Path, footage: DrivenSession, frames_per_s: int, constant_rate_factor: int = 26) -> None:
    """Write `video.mp4` and `commands.csv` (time_s, vehicle, the command's columns) of a session's first run.

    The first picture is taken at the first command, on whose clock the video begins at 0 s. Pictures at a control
    period's ends show the vehicles where they truly are; between those they go straight from one place to the next.

    Args:
        folder: where they are written.
        footage: what the stand-ins did.
        frames_per_s: pictures a second.
        constant_rate_factor: of the video's compression: the larger the smaller the file, and the worse.

    Raises:
        UserError: the robot's vehicles have no markers.
    """
    session = footage.session
    camera = OverheadCamera(session.robot, session.vehicles)
    images = _pictures(footage, camera, frames_per_s)
    coloured = (cv2.cvtColor(image, cv2.COLOR_GRAY2RGB) for image in images)
    write_video(folder / "video.mp4", coloured, frames_per_s, constant_rate_factor)
    time_s, command = footage.time_s[0] - footage.time_s[0, 0], footage.command[0]
    rows = [
        (round(float(sent_s), 4), vehicle, *command[row, index])
        for row, sent_s in enumerate(time_s[:-1])
        for index, vehicle in enumerate(session.vehicles)
    ]
    table = pd.DataFrame(rows, columns=["time_s", "vehicle", *session.robot.command_columns])
    write_text(folder / "commands.csv", table.to_csv(index=False))


def _pictures(footage: DrivenSession, camera: OverheadCamera, frames_per_s: int) -> Iterator[np.ndarray]:
    session = footage.session
    rng = Streams(session.seed, "film").of("pictures")
    time_s = footage.time_s[0] - footage.time_s[0, 0]
    rows = np.moveaxis(footage.state[:3, 0], 0, -1)
    shown_s = np.arange(int(time_s[-1] * frames_per_s + 1e-6) + 1) / frames_per_s
    seen = session.conditions.seen(rows)
    poses = np.stack([interpolate_poses(time_s, one, shown_s, np.inf) for one in np.moveaxis(seen, 1, 0)], axis=1)
    moment_s = 1e-3
    later = [interpolate_poses(time_s, one, shown_s + moment_s, np.inf) for one in np.moveaxis(seen, 1, 0)]
    velocity = np.nan_to_num((np.stack(later, axis=1) - poses) / moment_s)
    velocity[..., 2] = np.where(np.abs(velocity[..., 2]) < 100.0, velocity[..., 2], 0.0)
    for pose, moving in zip(poses, velocity, strict=True):
        yield camera.render(pose, rng, velocity=moving)
