"""Ways from a picture to poses that are compared: our tracker, and what one would write with OpenCV alone."""

from collections.abc import Callable, Mapping, Sequence
from typing import Literal

import cv2
import numpy as np

from swarmtwin.deploy.camera.camera import Frame
from swarmtwin.deploy.tracking.calibration import Calibration
from swarmtwin.deploy.tracking.marker_detection import MarkerDetector
from swarmtwin.deploy.tracking.tracker import Tracker
from swarmtwin.geometry import compose
from swarmtwin.markers import arena_markers, marker_of, vehicle_ids
from swarmtwin.robot import Robot

Method = Literal[
    "tracker", "measured_height", "measured_place", "measured_lens", "perfect", "subpixel", "contour", "homography"
]
Found = Mapping[str, np.ndarray]

TITLES: Mapping[Method, str] = {
    "tracker": "tracker, calibrated from pictures alone",
    "measured_height": "tracker, camera's height measured",
    "measured_place": "tracker, camera's height and plumb line",
    "measured_lens": "tracker, lens known from a board",
    "perfect": "tracker, perfect calibration",
    "subpixel": "OpenCV sub-pixel, perfect calibration",
    "contour": "OpenCV contour, perfect calibration",
    "homography": "OpenCV sub-pixel, homography of the floor",
}
"""What each method is called: five times our tracker, calibrated in five ways, and three plain ones."""


def tracked(calibration: Calibration, robot: Robot, vehicles: tuple[str, ...]) -> Callable[[np.ndarray], Found]:
    """Return our tracker, which knows nothing of the pictures before."""

    def find(image: np.ndarray) -> Found:
        return Tracker(calibration, robot, vehicles).track(Frame(0, 0.0, image)).poses

    return find


def corners_alone(
    calibration: Calibration, robot: Robot, vehicles: tuple[str, ...], refinement: int
) -> Callable[[np.ndarray], Found]:
    """Return OpenCV's detector with one of its refinements, its corners brought to the arena by our calibration."""
    height_mm = marker_of(robot).height_mm
    return _plain(robot, vehicles, refinement, lambda corners: calibration.to_arena(corners, height_mm))


def homography(
    pictures: Sequence[np.ndarray], robot: Robot, vehicles: tuple[str, ...]
) -> Callable[[np.ndarray], Found]:
    """Return OpenCV's detector with a homography from the arena's four markers, as tutorials do it.

    It knows neither the lens nor that vehicles' markers are raised. The four are found on any of the first pictures;
    where they are on none, nothing is found.
    """
    matrix = next((found for image in pictures if (found := _floor_homography(image, robot)) is not None), None)

    def to_arena(corners: np.ndarray) -> np.ndarray | None:
        return None if matrix is None else cv2.perspectiveTransform(corners[None], matrix)[0]

    return _plain(robot, vehicles, cv2.aruco.CORNER_REFINE_SUBPIX, to_arena)


def _floor_homography(image: np.ndarray, robot: Robot, reach_px: int = 3) -> np.ndarray | None:
    """Return the map (3, 3) from pixels to the arena's floor in mm; None: not all four markers are seen."""
    floor_mm = arena_markers(robot)
    seen = {one.number: one.corners for one in MarkerDetector(marker_of(robot).dictionary).find(image)}
    if not floor_mm.keys() <= seen.keys():
        return None
    corners = np.ascontiguousarray(np.concatenate([seen[number] for number in floor_mm]), np.float32)
    until = (cv2.TERM_CRITERIA_COUNT | cv2.TERM_CRITERIA_EPS, 30, 0.01)
    pixels = cv2.cornerSubPix(image, corners, (reach_px, reach_px), (-1, -1), until)
    return cv2.findHomography(pixels, np.concatenate(list(floor_mm.values())))[0]


def _plain(
    robot: Robot,
    vehicles: tuple[str, ...],
    refinement: int,
    to_arena: Callable[[np.ndarray], np.ndarray | None],
) -> Callable[[np.ndarray], Found]:
    marker, owners = marker_of(robot), vehicle_ids(robot, vehicles)
    parameters = cv2.aruco.DetectorParameters()
    parameters.cornerRefinementMethod = refinement
    printed = cv2.aruco.getPredefinedDictionary(getattr(cv2.aruco, marker.dictionary))
    detector = cv2.aruco.ArucoDetector(printed, parameters)
    turn_rad = np.deg2rad(marker.turn_deg)

    def find(image: np.ndarray) -> Found:
        corners, numbers, _ = detector.detectMarkers(image)
        seen = {
            int(number): np.asarray(one, float).reshape(4, 2)
            for number, one in zip(() if numbers is None else np.ravel(numbers), corners, strict=True)
        }
        found = {}
        for number, vehicle in owners.items():
            if number in seen and (corners_mm := to_arena(seen[number])) is not None:
                found[vehicle] = compose(
                    _pose_of(corners_mm, turn_rad), np.array([-marker.forward_mm, -marker.left_mm, 0.0])
                )
        return found

    return find


def _pose_of(corners_mm: np.ndarray, turn_rad: float) -> np.ndarray:
    """Return the vehicle's heading at its marker's centre (3,), from its corners (4, 2): their mean, and its edges."""
    upper_left, upper_right, lower_right, lower_left = corners_mm
    along = upper_right + lower_right - upper_left - lower_left
    return np.append(corners_mm.mean(axis=0), np.arctan2(along[1], along[0]) - turn_rad)
