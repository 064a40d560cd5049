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
        farthest_move: float = 0.085,
        even_light: float = 0.99,
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
            even_light: a correlation below which unevenness of the light is undone, and the search goes on.
        """
        self._printed = cv2.aruco.getPredefinedDictionary(getattr(cv2.aruco, dictionary))
        self._texels_per_cell, self._rim, self._blur = texels_per_cell, rim_texels, blur_texels
        self._side = (self._printed.markerSize + 2) * texels_per_cell
        low, high = rim_texels - 0.5, rim_texels - 0.5 + self._side
        self._square = np.array([[low, low], [high, low], [high, high], [low, high]])
        self._everywhere = np.full((self._side + 2 * rim_texels,) * 2, 255, np.uint8)
        self._until = (cv2.TERM_CRITERIA_COUNT | cv2.TERM_CRITERIA_EPS, most_iterations, precision)
        self._farthest_move, self._even_light = farthest_move, even_light
        rows, columns = np.indices(self._everywhere.shape) / (len(self._everywhere) - 1) - 0.5
        self._plane = np.column_stack([np.ones(rows.size), columns.ravel(), rows.ravel()])
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
        fit = self._fit(template, seen.astype(np.float32), np.eye(2, 3, dtype=np.float32))
        if fit is None:
            return marker
        correlation, found = fit
        if correlation < self._even_light:
            evened = self._evenly_lit(seen.astype(np.float32), template, found)
            correlation, found = self._fit(template, evened, found) or fit
        corners = _mapped(to_picture, _mapped(found.astype(float), self._square))
        side = np.linalg.norm(marker.corners[1] - marker.corners[0])
        moved = np.linalg.norm(corners - marker.corners, axis=1).max()
        return SeenMarker(marker.number, corners) if moved <= max(1.0, self._farthest_move * side) else marker

    def _fit(self, template: np.ndarray, seen: np.ndarray, start: np.ndarray) -> tuple[float, np.ndarray] | None:
        """Return the correlation and the affine map (2, 3) to what is seen; None: the search does not converge."""
        try:
            correlation, found = cv2.findTransformECC(
                template, seen, start.copy(), cv2.MOTION_AFFINE, self._until, self._everywhere, 1
            )
        except cv2.error:
            return None
        return correlation, found

    def _evenly_lit(self, seen: np.ndarray, template: np.ndarray, found: np.ndarray) -> np.ndarray:
        """Undo light and glare that change evenly across the marker: seen = plane · template + another plane."""
        printed = cv2.warpAffine(template, found, template.shape[::-1], borderMode=cv2.BORDER_REPLICATE).ravel() / 255
        plane = self._plane
        design = np.column_stack([plane * printed[:, None], plane])
        numbers = np.linalg.solve(design.T @ design, design.T @ seen.ravel())
        gain, glare = plane @ numbers[:3], plane @ numbers[3:]
        even = (seen.ravel() - glare) / np.maximum(gain, 0.05 * np.abs(gain).max() + 1e-3)
        return np.clip(255 * even, -128, 383).astype(np.float32).reshape(seen.shape)

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
