"""Corners of a marker to about a hundredth of a pixel, by laying its known picture over what the camera sees."""

from functools import lru_cache

import cv2
import numpy as np

from swarmtwin.deploy.tracking.marker_detection import SeenMarker


class CornerRefinement:
    """Moves a marker's corners so that its printed picture fits what is seen best.

    The region is resampled into the marker's own frame and the affine map that is left found with `findTransformECC`
    (Evangelidis and Psarakis, 2008), which does not mind brightness and contrast. All edges of the marker take part,
    and not just four corners. The start is the parallelogram nearest to the corners, so that their errors make no
    perspective that an affine map could not undo; within one marker true perspective is negligible.
    """

    def __init__(
        self,
        dictionary: str,
        texels_per_cell: int = 6,
        rim_texels: int = 4,
        blur_texels: float = 0.8,
        most_iterations: int = 20,
        precision: float = 1e-4,
        farthest_move: float = 0.06,
    ) -> None:
        """Prepare.

        Args:
            dictionary: of OpenCV.
            texels_per_cell: resolution of the resampled picture.
            rim_texels: width of the white round the marker that takes part.
            blur_texels: standard deviation of the blur of the printed picture, about that of a camera.
            most_iterations: of the search.
            precision: change of the correlation at which the search ends.
            farthest_move: of a corner, in sides of the marker; where the search goes farther, the start is better.
        """
        self._printed = cv2.aruco.getPredefinedDictionary(getattr(cv2.aruco, dictionary))
        self._texels_per_cell, self._rim, self._blur = texels_per_cell, rim_texels, blur_texels
        self._side = (self._printed.markerSize + 2) * texels_per_cell
        low, high = rim_texels - 0.5, rim_texels - 0.5 + self._side
        self._square = np.array([[low, low], [high, low], [high, high], [low, high]])
        self._everywhere = np.full((self._side + 2 * rim_texels,) * 2, 255, np.uint8)
        self._until = (cv2.TERM_CRITERIA_COUNT | cv2.TERM_CRITERIA_EPS, most_iterations, precision)
        self._farthest_move = farthest_move
        self._template = lru_cache(maxsize=64)(self._as_printed)

    def refine(self, grey: np.ndarray, marker: SeenMarker) -> SeenMarker:
        """Return a marker found on a picture (H, W), uint8, with better corners, or as it is where none can be found.

        In a mirrored picture, too: the corners say how it lies.
        """
        to_picture = _parallelogram(self._square, marker.corners)
        template = self._template(marker.number)
        seen = cv2.warpAffine(
            grey, to_picture, template.shape[::-1], flags=cv2.INTER_LINEAR | cv2.WARP_INVERSE_MAP,
            borderMode=cv2.BORDER_REPLICATE,
        )  # fmt: skip
        start = np.eye(2, 3, dtype=np.float32)
        try:
            _, found = cv2.findTransformECC(
                template, seen.astype(np.float32), start, cv2.MOTION_AFFINE, self._until, self._everywhere, 1
            )
        except cv2.error:  # the search does not converge
            return marker
        corners = _mapped(to_picture, _mapped(found.astype(float), self._square))
        side = np.linalg.norm(marker.corners[1] - marker.corners[0])
        moved = np.linalg.norm(corners - marker.corners, axis=1).max()
        return SeenMarker(marker.number, corners) if moved <= max(1.0, self._farthest_move * side) else marker

    def _as_printed(self, number: int) -> np.ndarray:
        """Return the marker with its rim, float32, blurred."""
        finer = 4
        square = cv2.aruco.generateImageMarker(self._printed, number, self._side * finer)
        rim = self._rim * finer
        whole = cv2.copyMakeBorder(square, rim, rim, rim, rim, cv2.BORDER_CONSTANT, value=255)
        size = (self._side + 2 * self._rim,) * 2
        return cv2.GaussianBlur(
            cv2.resize(whole.astype(np.float32), size, interpolation=cv2.INTER_AREA), (0, 0), self._blur
        )


def _parallelogram(square: np.ndarray, corners: np.ndarray) -> np.ndarray:
    """Return the affine map (2, 3) from a square's corners (4, 2) to the parallelogram nearest to four corners."""
    design = np.column_stack([square, np.ones(4)])
    return np.linalg.lstsq(design, corners, rcond=None)[0].T


def _mapped(affine: np.ndarray, points: np.ndarray) -> np.ndarray:
    return points @ affine[:, :2].T + affine[:, 2]
