"""A camera's picture with what its calibration says drawn over it, for a person to judge."""

from collections.abc import Mapping
from itertools import pairwise

import cv2
import numpy as np

from swarmtwin.deploy.tracking.calibration import Calibration
from swarmtwin.geometry import rotate
from swarmtwin.robot import Robot

Colour = tuple[int, int, int]


class CalibratedPicture:
    """Draws things of the arena where they are seen.

    Attributes:
        image: (H, W, 3) blue, green, red.
    """

    def __init__(self, image: np.ndarray, calibration: Calibration) -> None:
        """Take a copy of a picture, grey or in colour, and the calibration of its camera."""
        self.image = cv2.cvtColor(image, cv2.COLOR_GRAY2BGR) if image.ndim == 2 else image.copy()
        self._calibration = calibration

    def line(self, points_mm: np.ndarray, height_mm: float, colour: Colour, width_px: int = 1) -> None:
        """Draw straight lines between points (N, 2) at a height, as bent as the lens shows them."""
        share = np.linspace(0, 1, 24)[:, None]
        pieces = [start + share * (end - start) for start, end in pairwise(points_mm)]
        path = self._pixels(np.concatenate(pieces), height_mm)
        cv2.polylines(self.image, [np.round(path * 16).astype(np.int32)], False, colour, width_px, cv2.LINE_AA, 4)

    def arrow(self, start_mm: np.ndarray, end_mm: np.ndarray, height_mm: float, colour: Colour) -> None:
        """Draw an arrow between two points (2,)."""
        start, end = self._pixels(np.array([start_mm, end_mm]), height_mm)
        tail, tip = start.round().astype(int).tolist(), end.round().astype(int).tolist()
        cv2.arrowedLine(self.image, tail, tip, colour, 2, cv2.LINE_AA, tipLength=0.2)

    def text(self, words: str, place_mm: np.ndarray, height_mm: float, colour: Colour) -> None:
        """Write words beside a point (2,)."""
        x_px, y_px = np.round(self._pixels(np.asarray(place_mm)[None], height_mm)[0]).astype(int).tolist()
        cv2.putText(self.image, words, (x_px + 6, y_px - 6), cv2.FONT_HERSHEY_SIMPLEX, 0.5, colour, 1, cv2.LINE_AA)

    def _pixels(self, points_mm: np.ndarray, height_mm: float) -> np.ndarray:
        return self._calibration.to_pixels(np.column_stack([points_mm, np.full(len(points_mm), height_mm)]))


def drawn(
    image: np.ndarray, calibration: Calibration, robot: Robot, poses: Mapping[str, np.ndarray], height_mm: float
) -> np.ndarray:
    """Return a picture (H, W, 3) with the arena's axes and fence, its four markers, and the vehicles' outlines.

    Args:
        image: the camera's.
        calibration: of the camera.
        robot: says how large vehicles are.
        poses: (3,) of each vehicle that is seen.
        height_mm: of the vehicles' markers, at which they are drawn.
    """
    red, green, blue, yellow = (60, 60, 230), (80, 200, 80), (230, 140, 40), (60, 210, 240)
    picture = CalibratedPicture(image, calibration)
    (low_x, low_y), (high_x, high_y) = calibration.arena_mm.low_mm, calibration.arena_mm.high_mm
    fence = [[low_x, low_y], [high_x, low_y], [high_x, high_y], [low_x, high_y], [low_x, low_y]]
    picture.line(np.array(fence), 0.0, yellow)
    for number, corners in calibration.floor_markers_mm.items():
        picture.line(np.vstack([corners, corners[:1]]), 0.0, yellow)
        picture.text(str(number), corners.mean(axis=0), 0.0, yellow)
    low, length_mm = np.array([low_x, low_y]), 0.15 * min(high_x - low_x, high_y - low_y)
    for name, along, colour in (("x", [length_mm, 0], red), ("y", [0, length_mm], green)):
        picture.arrow(low, low + along, 0.0, colour)
        picture.text(name, low + along, 0.0, colour)
    half = np.array(robot.vehicle_size_mm) / 2
    outline = np.array([[-1, -1], [1, -1], [1, 1], [-1, 1], [-1, -1]]) * half
    for vehicle, pose in poses.items():
        picture.line(pose[:2] + rotate(outline, np.full(5, pose[2])), height_mm, blue, 1)
        ahead = rotate(np.array([robot.vehicle_size_mm[0], 0.0]), np.asarray(pose[2]))
        picture.arrow(pose[:2], pose[:2] + ahead, height_mm, blue)
        picture.text(vehicle, pose[:2] + half[1], height_mm, blue)
    return picture.image
