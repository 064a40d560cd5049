"""ArUco markers on a picture: which are seen, and where their corners are to about a fifth of a pixel."""

from collections.abc import Iterable, Sequence
from typing import NamedTuple

import cv2
import numpy as np

Box = tuple[slice, slice]
"""Rows and columns of a picture."""


class SeenMarker(NamedTuple):
    """A marker on a picture.

    Attributes:
        number: its id.
        corners: (4, 2) x to the right and y down in pixels: upper left, upper right, lower right, lower left corner of
            the marker as printed. Pixel (0, 0)'s centre is at (0, 0).
    """

    number: int
    corners: np.ndarray


class MarkerDetector:
    """Finds the markers of one dictionary with OpenCV.

    Thresholding takes most of the time, so where the markers' size is known one window is used that fits it; else
    several are tried, each by itself: together they would find fewer, as a marker and the white around it are taken for
    one.
    """

    def __init__(
        self,
        dictionary: str,
        cell_px: float | None = None,
        mirrored: bool = False,
        cells_in_window: float = 2.0,
        threshold: float = 7.0,
        tried_windows: tuple[int, ...] = (7, 11, 23, 45),
    ) -> None:
        """Prepare.

        Args:
            dictionary: of OpenCV.
            cell_px: about how large a cell of a marker is seen; None: nobody knows.
            mirrored: the pictures show left and right exchanged, in which a marker cannot be read unless undone.
            cells_in_window: side of the square that a pixel's brightness is compared with the mean of.
            threshold: grey levels below that mean that make a pixel dark.
            tried_windows: sides in pixels of those squares where nobody knows `cell_px`.
        """
        fitting = () if cell_px is None else (max(5, 2 * round((cells_in_window * cell_px - 1) / 2) + 1),)
        self.mirrored = mirrored
        self._detectors = [_detector(dictionary, window, threshold) for window in fitting or tried_windows]

    def find(self, grey: np.ndarray) -> list[SeenMarker]:
        """Return all markers on a picture (H, W), uint8; an id that is there several times, several times."""
        if self.mirrored:
            grey = cv2.flip(grey, 1)
        seen: list[SeenMarker] = []
        for detector in self._detectors:
            corners, numbers, _ = detector.detectMarkers(grey)
            for number, one in zip(() if numbers is None else np.ravel(numbers), corners, strict=True):
                marker = SeenMarker(int(number), _outline(np.asarray(one, float).reshape(4, 2)))
                if not _is_among(marker, seen):
                    seen.append(marker)
        if self.mirrored:
            return [SeenMarker(number, [grey.shape[1] - 1, 0] + one * [-1, 1]) for number, one in seen]
        return seen

    def find_within(self, grey: np.ndarray, boxes: Iterable[Box]) -> list[SeenMarker]:
        """Return the markers that lie within parts of a picture; boxes that overlap show one marker once."""
        seen: list[SeenMarker] = []
        for rows, columns in boxes:
            for marker in self.find(np.ascontiguousarray(grey[rows, columns])):
                moved = SeenMarker(marker.number, marker.corners + np.array([columns.start, rows.start]))
                if not _is_among(moved, seen):
                    seen.append(moved)
        return seen


def grey_of(image: np.ndarray) -> np.ndarray:
    """Return a picture, (H, W) or (H, W, 3) blue, green, red, as grey (H, W), uint8."""
    return image if image.ndim == 2 else cv2.cvtColor(image, cv2.COLOR_BGR2GRAY)


def side_px(corners: np.ndarray) -> float:
    """Return the mean length of the sides of a square seen at corners (4, 2)."""
    return float(np.linalg.norm(corners - np.roll(corners, 1, axis=0), axis=1).mean())


def cells_along(dictionary: str) -> int:
    """Return how many cells there are along a side of a dictionary's markers, its black border included."""
    return cv2.aruco.getPredefinedDictionary(getattr(cv2.aruco, dictionary)).markerSize + 2


def _detector(dictionary: str, window_px: int, threshold: float) -> cv2.aruco.ArucoDetector:
    parameters = cv2.aruco.DetectorParameters()
    parameters.adaptiveThreshWinSizeMin = parameters.adaptiveThreshWinSizeMax = window_px
    parameters.adaptiveThreshConstant = threshold
    printed = cv2.aruco.getPredefinedDictionary(getattr(cv2.aruco, dictionary))
    return cv2.aruco.ArucoDetector(printed, parameters)


def _outline(corners: np.ndarray) -> np.ndarray:
    """Return a marker's outer corners (4, 2): OpenCV's contour runs through the centres of its outermost pixels."""
    centre = corners.mean(axis=0)
    return centre + (corners - centre) * (1 + 1 / side_px(corners))


def _is_among(marker: SeenMarker, seen: Sequence[SeenMarker]) -> bool:
    centre, near = marker.corners.mean(axis=0), side_px(marker.corners) / 2
    return any(
        other.number == marker.number and np.linalg.norm(other.corners.mean(axis=0) - centre) < near for other in seen
    )
