"""`swarmtwin calibrate`: where an overhead camera hangs, from the arena's four markers."""

import logging
from pathlib import Path
from typing import Annotated, Any

import cv2
import numpy as np
from pydantic import Field
from rich.console import Console

from swarmtwin.deploy.camera.camera import Frame
from swarmtwin.deploy.camera.opening import open_camera
from swarmtwin.deploy.tracking.calibration import Calibration
from swarmtwin.deploy.tracking.calibration_fit import MeasuredByHand, fit_calibration
from swarmtwin.deploy.tracking.calibration_pictures import take_pictures
from swarmtwin.deploy.tracking.drawing import drawn
from swarmtwin.deploy.tracking.lens_board import Board, measure_lens
from swarmtwin.deploy.tracking.marker_detection import MarkerDetector, grey_of
from swarmtwin.deploy.tracking.tracker import Tracker
from swarmtwin.errors import UserError
from swarmtwin.files import whole_file
from swarmtwin.markers import ArenaMarkers, marker_of
from swarmtwin.robot import Positive, Robot, StrictModel

log = logging.getLogger(__name__)


class BoardOptions(Board):
    """A board, and pictures of it."""

    pictures: str | None


class Options(StrictModel):
    """Options of `swarmtwin calibrate`; their defaults stand in conf/calibrate.yaml."""

    robot: Robot
    camera: str
    pictures: Annotated[int, Field(ge=1, le=1000)]
    camera_height_mm: Positive | None
    camera_above_mm: tuple[float, float] | None
    markers: ArenaMarkers
    board: BoardOptions
    output: Path
    overwrite: bool


def run(options: Options) -> dict[str, Any]:
    """Calibrate, save the file and a picture of what it says, and return how good it is.

    Raises:
        UserError: there is no such camera, its pictures do not show the arena, or the output is taken.
    """
    _check_output(options)
    robot = options.robot
    marker_of(robot)
    lens = None
    if options.board.pictures is not None:
        lens = measure_lens(_pictures(options.board.pictures, 60), options.board)
    pictures = _pictures(options.camera, options.pictures)
    by_hand = MeasuredByHand(options.camera_height_mm, options.camera_above_mm)
    calibration = fit_calibration(pictures, robot, options.markers, lens, by_hand)
    poses = _vehicles_on(pictures[-1], calibration, robot)
    picture = drawn(pictures[-1], calibration, robot, poses, marker_of(robot).height_mm)
    options.output.parent.mkdir(parents=True, exist_ok=True)
    with whole_file(options.output) as file:
        calibration.save(file)
    shown = options.output.with_suffix(".png")
    shown.write_bytes(cv2.imencode(".png", picture)[1].tobytes())
    _report(calibration, options, poses, shown)
    return {
        "reprojection_px": round(calibration.reprojection_px, 4),
        "uncertainty_mm": round(calibration.uncertainty_mm, 3),
        "output": str(options.output),
    }


def _check_output(options: Options) -> None:
    if options.output.suffix not in (".yaml", ".yml"):
        raise UserError(f"output={options.output}: a calibration is a YAML file: give it the ending .yaml")
    if options.output.exists() and not options.overwrite:
        raise UserError(f"{options.output} exists: give another output, or overwrite=true to replace it")


def _pictures(source: str, count: int) -> list[np.ndarray]:
    camera = open_camera(source)
    try:
        return take_pictures(camera, count)
    finally:
        camera.close()


def _vehicles_on(picture: np.ndarray, calibration: Calibration, robot: Robot) -> dict[str, np.ndarray]:
    """Return the poses (3,) of all vehicles on a picture, whichever they are."""
    marker = marker_of(robot)
    names = {number: name for name, number in marker.ids.items()}
    seen = MarkerDetector(marker.dictionary, mirrored=calibration.mirrored).find(grey_of(picture))
    numbers = sorted({one.number for one in seen} - set(calibration.layout.ids))
    vehicles = [names.get(number, str(number)) for number in numbers]
    sighting = Tracker(calibration, robot, vehicles).track(Frame(0, 0.0, picture))
    for vehicle, reason in sighting.doubts.items():
        log.warning("vehicle %s: %s", vehicle, reason)
    return dict(sighting.poses)


def _report(calibration: Calibration, options: Options, poses: dict[str, np.ndarray], shown: Path) -> None:
    console = Console()
    console.print(calibration.summary(options.robot), highlight=False, soft_wrap=True)
    for vehicle, (x_mm, y_mm, heading_rad) in poses.items():
        place = f"vehicle {vehicle} at x {x_mm:.0f}, y {y_mm:.0f} mm, heading {np.rad2deg(heading_rad):.0f}°"
        console.print(place, highlight=False, soft_wrap=True)
    if not poses and options.camera_height_mm is None:
        log.warning(
            "no vehicle is seen, so the camera's height is known poorly, and vehicles would be seen displaced: put "
            "some on the arena, at several places, or give camera_height_mm=..."
        )
    console.print(f"{options.output}; look at {shown}: do fence and arrows lie where they should?", soft_wrap=True)
